"use strict";
const $ = (id) => document.getElementById(id);
const NOTHING = -32768;
const TASKS = { lt: "left turn", gs_inner: "straight on, inner lane", gs_outer: "straight on, outer lane", rt: "right turn" };
const TASK_OF = { lt: "left turn", gs_inner: "straight on", gs_outer: "straight on", rt: "right turn" };
const ENDS = { success: "arrives", hit_vehicle: "hits a car", left_road: "leaves the road", frozen: "still on the road" };
const state = { run: 0, other: -1, episode: 0, row: 0, playing: false };

// --- data ---------------------------------------------------------------------------------------

async function unpack(run) {
  const bytes = Uint8Array.from(atob(run.data), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const table = new Int16Array(await new Response(stream).arrayBuffer());
  const rows = run.rows;
  for (let begin = 0; begin < table.length; begin += rows)
    for (let i = begin + 1; i < begin + rows; i++) table[i] += table[i - 1];
  let column = 0;
  run.columns = {};
  for (const [name, shape, scales] of run.layout) {
    const width = shape.reduce((a, b) => a * b, 1), each = scales.length;
    run.columns[name] = { first: column, width, scales, each };
    column += width;
  }
  run.table = table;
  delete run.data;
}

/** One number of a row, NaN where there is none. */
function at(run, name, row, index = 0) {
  const { first, scales, each } = run.columns[name];
  const value = run.table[(first + index) * run.rows + row];
  return value === NOTHING ? NaN : value / scales[index % each];
}
const width = (run, name) => run.columns[name].width;
const cars = (run) => width(run, "gap") && run.columns.attention.width;
const firstRow = (run, episode) => run.episodes.first[episode];
const count = (run, episode) => run.episodes.first[episode + 1] - run.episodes.first[episode];
/** What tells tests apart, where they differ in it. */
const differs = (key) => new Set(DATA.runs.map((r) => r.about[key])).size > 1;
const runName = (run) => [run.about.label, ...["task", "scenario", "env"].filter(differs).map((key) => run.about[key])].join(", ");
const seedOf = (run) => run.about.training_seed ?? "-";
const called = (run) => runName(run) + (run.about.training_seed === undefined ? "" : `, seed ${run.about.training_seed}`);

// --- choosing -----------------------------------------------------------------------------------

function options(select, entries, chosen) {
  select.replaceChildren(...entries.map(([value, text]) => new Option(text, value, false, String(value) === String(chosen))));
}

function wanted(run) {
  const task = $("task").value, end = $("outcome").value;
  return run.episodes.episode.map((_, i) => i).filter((i) => {
    const outcome = run.episodes.outcome[i];
    const crash = outcome === "hit_vehicle" || outcome === "left_road";
    return (!task || TASK_OF[run.episodes.route[i]] === task) && (!end || outcome === end || (end === "crash" && crash));
  });
}

function showRuns() {
  const names = [...new Set(DATA.runs.map(runName))], mine = DATA.runs[state.run];
  options($("run"), names.map((n) => [n, n]), runName(mine));
  const same = DATA.runs.map((r, i) => [i, r]).filter(([, r]) => runName(r) === runName(mine));
  $("seed").parentElement.hidden = same.length < 2;
  options($("seed"), same.map(([i, r]) => [i, seedOf(r)]), state.run);
  options($("other"), [[-1, "nobody"], ...DATA.runs.map((r, i) => [i, called(r)])
    .filter(([i]) => Number(i) !== state.run)], state.other);
}

function showEpisodes() {
  const run = DATA.runs[state.run], found = wanted(run);
  if (!found.includes(state.episode) && found.length) state.episode = found[0];
  options($("episode"), found.map((i) => [i, `${run.episodes.episode[i]}: ${TASK_OF[run.episodes.route[i]]}, ${ENDS[run.episodes.outcome[i]]}`]),
    state.episode);
  $("count").textContent = `${found.length} of ${run.episodes.episode.length} episodes`;
  $("episode").disabled = !found.length;
  $("stage").hidden = $("charts").hidden = !found.length;
}

/** Who is shown: [run, episode] of the chosen one, and of the other on the same traffic. */
function shown() {
  const mine = DATA.runs[state.run], list = [[mine, state.episode]];
  if (state.other >= 0) {
    const other = DATA.runs[state.other];
    const episode = other.episodes.seed.indexOf(mine.episodes.seed[state.episode]);
    list.push([other, episode >= 0 && alike(mine, state.episode, other, episode) ? episode : -1]);
  }
  return list;
}
/** Whether two episodes begin with the same cars in the same places. */
function alike(mine, a, other, b) {
  if (mine.episodes.route[a] !== other.episodes.route[b] || cars(mine) !== cars(other)) return false;
  for (let k = 0; k < 6 * cars(mine); k++) {
    const [x, y] = [at(mine, "vehicles", firstRow(mine, a), k), at(other, "vehicles", firstRow(other, b), k)];
    if (Number.isNaN(x) !== Number.isNaN(y) || Math.abs(x - y) > 0.03) return false;
  }
  return true;
}
const longest = () => Math.max(...shown().map(([run, e]) => (e < 0 ? 1 : count(run, e))));
const dt = () => DATA.runs[state.run].about.dt;

function choose(changes) {
  Object.assign(state, changes);
  showRuns();
  showEpisodes();
  state.row = Math.min(state.row, longest() - 1);
  $("time").max = longest() - 1;
  build();
  draw();
}

function step(by) {
  const found = wanted(DATA.runs[state.run]);
  if (!found.length) return;
  const next = found[(found.indexOf(state.episode) + by + found.length) % found.length];
  choose({ episode: next, row: 0 });
}

// --- drawing ------------------------------------------------------------------------------------

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

function canvas(parent, caption, height) {
  const figure = document.createElement("figure"), text = document.createElement("figcaption");
  const element = document.createElement("canvas");
  text.append(...caption);
  figure.append(text, element);
  parent.append(figure);
  element.wanted = height;
  return element;
}

function context(element) {
  const ratio = window.devicePixelRatio || 1, box = element.getBoundingClientRect();
  const w = Math.max(1, Math.round(box.width * ratio)), h = Math.max(1, Math.round(box.height * ratio));
  if (element.width !== w || element.height !== h) { element.width = w; element.height = h; }
  const c = element.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, box.width, box.height);
  return [c, box.width, box.height];
}

let scenes = [], charts = [];
const CHARTS = [
  { title: "speed", unit: "m/s", least: [0, 12], lines: [{ name: "ego", colour: "ego", of: (r, i) => Math.hypot(at(r, "ego", i, 2), at(r, "ego", i, 3)) }] },
  { title: "acceleration", unit: "m/s²", least: [-5, 5], lines: [
    { name: "proposed", colour: "after", dash: true, of: (r, i) => at(r, "proposed", i, 0) },
    { name: "executed", colour: "ego", of: (r, i) => at(r, "executed", i, 0) }] },
  { title: "steering", unit: "rad", least: [-0.3, 0.3], lines: [
    { name: "proposed", colour: "after", dash: true, of: (r, i) => at(r, "proposed", i, 1) },
    { name: "executed", colour: "ego", of: (r, i) => at(r, "executed", i, 1) }] },
  { title: "risk by the cost critics", unit: "", least: [0, 0.1], limit: true, members: true, lines: [
    { name: "proposed", colour: "after", dash: true, of: (r, i) => at(r, "risk", i) },
    { name: "executed", colour: "ego", of: (r, i) => at(r, "risk_executed", i) }] },
  { title: "cost of the decision", unit: "", least: [0, 0.05], lines: [{ name: "cost", colour: "risk", of: (r, i) => at(r, "cost", i) }] },
  { title: "gap to the nearest car", unit: "m", least: [0, 20], lines: [{ name: "gap", colour: "ego", of: (r, i) => at(r, "gap", i) }] },
];

function swatch(name, text) {
  const mark = document.createElement("span");
  mark.className = "swatch";
  mark.style.background = `var(--${name})`;
  return [mark, text];
}

function build() {
  $("scenes").replaceChildren();
  $("charts").replaceChildren();
  const who = shown();
  scenes = who.map(([run, episode]) => {
    const caption = document.createElement("b");
    caption.textContent = called(run);
    const words = episode < 0 ? ": it has not played this episode in this traffic"
      : `: episode ${run.episodes.episode[episode]}, ${TASKS[run.episodes.route[episode]]}, ${ENDS[run.episodes.outcome[episode]]} at ${((count(run, episode) - 1) * run.about.dt).toFixed(1)} s`;
    const element = canvas($("scenes"), [caption, words]);
    element.parentElement.classList.toggle("alone", who.length === 1);
    element.style.aspectRatio = who.length === 1 ? "16 / 10" : "1 / 1";
    return { run, episode, element };
  });
  const [run, episode] = who[0];
  const has = (name) => !Number.isNaN(at(run, name, firstRow(run, episode)));
  charts = CHARTS.filter((chart) => !chart.limit || has("risk")).map((chart) => {
    const title = document.createElement("b");
    title.textContent = chart.title + (chart.unit ? `, ${chart.unit}` : "");
    const notes = chart.lines.length > 1 ? chart.lines.flatMap((line) => swatch(line.colour, line.name)) : [];
    if (who.length > 1) notes.push(...swatch("first", called(who[1][0])));
    const element = canvas($("charts"), [title, ...notes]);
    element.addEventListener("click", (event) => {
      const box = element.getBoundingClientRect();
      const share = (event.clientX - box.left - 34) / (box.width - 40);
      state.row = Math.max(0, Math.min(longest() - 1, Math.round(share * (longest() - 1))));
      draw();
    });
    return { ...chart, element };
  });
  const legend = [...swatch("ego", "ego"), ...swatch("first", "goes first by the rules of the road"),
    ...swatch("after", "comes after the ego"), ...swatch("risk", "outlined: a predicted collision is part of the cost"),
    ...swatch("halo", "ring: the policy looks at it (width: root of its share of the attention)"), " · pale: not observed", ...swatch("halo", "shaded in the curves: the projector acted")];
  $("legend").replaceChildren(...legend);
}

function drawRoad(c, route) {
  const { arm, box, lane, curb, lines } = DATA.road, end = box + arm;
  c.fillStyle = colour("road");
  c.fillRect(-2 * lane, -end, 4 * lane, 2 * end);
  c.fillRect(-end, -2 * lane, 2 * end, 4 * lane);
  c.fillRect(-box, -box, 2 * box, 2 * box);
  c.fillStyle = colour("grass");
  for (const x of [-box, box]) for (const y of [-box, box]) { c.beginPath(); c.arc(x, y, curb, 0, 7); c.fill(); }
  for (let turn = 0; turn < 4; turn++) {
    c.strokeStyle = colour("mark");
    c.lineWidth = 0.18;
    for (const side of [-lane, lane]) { c.setLineDash([2, 2]); c.beginPath(); c.moveTo(box, side); c.lineTo(end, side); c.stroke(); }
    c.setLineDash([]);
    c.beginPath(); c.moveTo(box, 0); c.lineTo(box, -2 * lane); c.lineWidth = 0.4; c.stroke();
    c.strokeStyle = colour("faint"); c.lineWidth = 0.2;
    c.beginPath(); c.moveTo(box, 0); c.lineTo(end, 0); c.stroke();
    c.rotate(Math.PI / 2);
  }
  c.strokeStyle = colour("faint");
  c.setLineDash([0.5, 1.2]);
  c.lineWidth = 0.25;
  for (const line of lines[route]) {
    c.beginPath();
    line.forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
    c.stroke();
  }
  c.setLineDash([]);
}

function car(c, x, y, heading, fill, look = {}) {
  const { length: l, width: w } = DATA.road;
  c.save();
  c.translate(x, y);
  c.rotate(heading);
  c.globalAlpha = look.pale ? 0.35 : 1;
  if (look.ring) { c.strokeStyle = colour("halo"); c.lineWidth = 0.2 + 1.6 * look.ring; c.beginPath(); c.arc(0, 0, 3.6, 0, 7); c.stroke(); }
  c.fillStyle = fill;
  c.beginPath();
  c.moveTo(-l / 2, -w / 2); c.lineTo(0.3 * l, -w / 2); c.lineTo(l / 2, -w / 4); c.lineTo(l / 2, w / 4); c.lineTo(0.3 * l, w / 2); c.lineTo(-l / 2, w / 2);
  c.closePath();
  c.fill();
  if (look.outline) { c.strokeStyle = look.outline; c.lineWidth = 0.45; c.stroke(); }
  c.fillStyle = colour("ground");
  c.globalAlpha *= 0.8;
  c.fillRect(0.12 * l, -0.35 * w, 0.14 * l, 0.7 * w);
  c.restore();
  if (look.label !== undefined) {
    c.fillStyle = look.pale ? colour("faint") : "#fff";
    c.font = "bold 1.7px system-ui, sans-serif";
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillText(look.label, x - 0.8 * Math.cos(heading), y - 0.8 * Math.sin(heading));
  }
}

function drawScene({ run, episode, element }) {
  const [c, w, h] = context(element);
  if (episode < 0) return;
  const base = firstRow(run, episode), last = count(run, episode) - 1, row = base + Math.min(state.row, last);
  const x = at(run, "ego", row, 0), y = at(run, "ego", row, 1);
  // The middle of the junction and the ego are both in sight.
  const view = 40, scale = Math.min(w, h) / (2 * view);
  const cx = Math.max(-24, Math.min(24, 0.45 * x)), cy = Math.max(-24, Math.min(24, 0.45 * y));
  c.translate(w / 2, h / 2);
  c.scale(scale, scale);
  c.translate(-cx, -cy);
  c.lineJoin = "round";
  drawRoad(c, run.episodes.route[episode]);
  c.strokeStyle = colour("ego");
  c.lineWidth = 0.35;
  c.beginPath();
  for (let i = base; i <= row; i++) c.lineTo(at(run, "ego", i, 0), at(run, "ego", i, 1));
  c.stroke();
  for (let k = 0; k < cars(run); k++) {
    const vx = at(run, "vehicles", row, 6 * k);
    if (Number.isNaN(vx)) continue;
    const first = at(run, "priority", row, k) > 0, share = at(run, "attention", row, k) || 0;
    car(c, vx, at(run, "vehicles", row, 6 * k + 1), at(run, "vehicles", row, 6 * k + 4), colour(first ? "first" : "after"), {
      label: k, pale: !(at(run, "observed", row, k) > 0) && Math.min(state.row, last) < last, ring: share > 0.002 ? Math.sqrt(share) : 0,
      outline: at(run, "cost_share", row, k) > 0 ? colour("risk") : null });
  }
  const acted = at(run, "intervened", row) > 0;
  car(c, x, y, at(run, "ego", row, 4), colour("ego"), { outline: acted ? colour("ink") : null });
  const end = run.episodes.outcome[episode];
  if (state.row >= last && (end === "hit_vehicle" || end === "left_road")) {
    c.strokeStyle = colour("risk");
    c.lineWidth = 0.6;
    c.beginPath(); c.arc(x, y, 4.6, 0, 7); c.stroke();
  }
  c.setTransform(1, 0, 0, 1, 0, 0);
  c.scale(window.devicePixelRatio || 1, window.devicePixelRatio || 1);
  c.fillStyle = colour("ink");
  c.strokeStyle = colour("ink");
  c.font = "12px system-ui, sans-serif";
  c.textAlign = "left";
  c.lineWidth = 2;
  c.beginPath(); c.moveTo(12, h - 12); c.lineTo(12 + 10 * scale, h - 12); c.stroke();
  c.fillText("10 m, north is up", 12, h - 18);
  if (acted) { c.textAlign = "right"; c.font = "bold 13px system-ui, sans-serif"; c.fillText("the projector corrects", w - 10, 20); }
}

function drawChart(chart) {
  const [c, w, h] = context(chart.element), left = 34, right = w - 6, top = 6, bottom = h - 16;
  const who = shown(), n = longest();
  const curves = [];
  who.forEach(([run, episode], which) => {
    if (episode < 0) return;
    const base = firstRow(run, episode), rows = count(run, episode);
    const lines = which ? [chart.lines[chart.lines.length - 1]] : chart.lines;
    if (!which && chart.members)
      for (let m = 0; m < width(run, "members"); m++)
        curves.push({ colour: "faint", thin: true, values: Array.from({ length: rows }, (_, i) => at(run, "members", base + i, m)) });
    for (const line of lines)
      curves.push({ colour: which ? "first" : line.colour, dash: !which && line.dash, values: Array.from({ length: rows }, (_, i) => line.of(run, base + i)) });
  });
  const run = who[0][0], limit = chart.limit ? run.about.risk_limit : null;
  let [low, high] = chart.least;
  for (const curve of curves) for (const v of curve.values) if (!Number.isNaN(v)) { low = Math.min(low, v); high = Math.max(high, v); }
  const px = (i) => left + ((right - left) * i) / Math.max(1, n - 1), py = (v) => bottom - ((bottom - top) * (v - low)) / (high - low || 1);
  if (who[0][1] >= 0) {  // where the projector acted
    const base = firstRow(run, who[0][1]);
    c.fillStyle = colour("halo");
    c.globalAlpha = 0.3;
    for (let i = 0; i < count(run, who[0][1]) - 1; i++) if (at(run, "intervened", base + i) > 0) c.fillRect(px(i), top, px(i + 1) - px(i) + 0.5, bottom - top);
    c.globalAlpha = 1;
  }
  c.strokeStyle = colour("line");
  c.fillStyle = colour("faint");
  c.font = "11px system-ui, sans-serif";
  c.lineWidth = 1;
  c.textAlign = "right";
  for (const v of [low, (low + high) / 2, high]) {
    c.beginPath(); c.moveTo(left, py(v)); c.lineTo(right, py(v)); c.stroke();
    c.fillText(Math.abs(high - low) < 2 ? v.toFixed(2) : v.toFixed(0), left - 4, py(v) + 4);
  }
  c.textAlign = "center";
  const seconds = (n - 1) * dt(), every = seconds > 14 ? 5 : seconds > 6 ? 2 : 1;
  for (let s = 0; s <= seconds; s += every) c.fillText(`${s} s`, Math.min(right - 8, px(s / dt())), h - 3);
  if (limit !== null) {
    c.strokeStyle = colour("risk"); c.setLineDash([5, 4]);
    c.beginPath(); c.moveTo(left, py(limit)); c.lineTo(right, py(limit)); c.stroke();
    c.setLineDash([]); c.fillStyle = colour("risk"); c.textAlign = "right"; c.fillText("limit", right, py(limit) - 3);
  }
  for (const curve of curves) {
    c.strokeStyle = colour(curve.colour);
    c.lineWidth = curve.thin ? 0.8 : 1.8;
    c.setLineDash(curve.dash ? [4, 3] : []);
    c.beginPath();
    let pen = false;
    curve.values.forEach((v, i) => { if (Number.isNaN(v)) { pen = false; return; } if (pen) c.lineTo(px(i), py(v)); else c.moveTo(px(i), py(v)); pen = true; });
    c.stroke();
  }
  c.setLineDash([]);
  c.strokeStyle = colour("ink");
  c.lineWidth = 1;
  c.beginPath(); c.moveTo(px(state.row), top); c.lineTo(px(state.row), bottom); c.stroke();
}

function words() {
  const [run, episode] = shown()[0], last = count(run, episode) - 1;
  const row = firstRow(run, episode) + Math.min(state.row, last), near = at(run, "nearest", row);
  const parts = [`${Math.hypot(at(run, "ego", row, 2), at(run, "ego", row, 3)).toFixed(1)} m/s`];
  if (near >= 0) {
    const who = at(run, "priority", row, near) > 0 ? "goes first" : "comes after the ego";
    parts.push(`nearest: car ${near} (${run.ways[at(run, "vehicle_route", row, near)]}), ${at(run, "gap", row).toFixed(1)} m away, ${who}`);
  }
  const looks = Array.from({ length: cars(run) }, (_, k) => [at(run, "attention", row, k), k]).filter(([share]) => share > 0.005);
  if (looks.length) {
    const [share, most] = looks.sort((a, b) => b[0] - a[0])[0];
    parts.push(`looks most at car ${most} (${(100 * share).toFixed(0)}% of the attention)`);
  }
  const risk = at(run, "risk", row);
  if (!Number.isNaN(risk)) parts.push(`risk ${risk.toFixed(3)}` + (run.about.risk_limit === null ? "" : ` of ${run.about.risk_limit}`));
  if (at(run, "intervened", row) > 0) parts.push(`corrected to ${at(run, "risk_executed", row).toFixed(3)}`);
  $("now").textContent = parts.join(" · ");
}

function draw() {
  scenes.forEach(drawScene);
  charts.forEach(drawChart);
  $("time").value = state.row;
  $("clock").textContent = `${(state.row * dt()).toFixed(1)} of ${((longest() - 1) * dt()).toFixed(1)} s`;
  $("play").textContent = state.playing ? "❚❚" : "▶";
  words();
}

// --- playing ------------------------------------------------------------------------------------

let timer = null, before = 0, owed = 0;
function tick() {
  const now = performance.now();
  owed += ((now - before) / 1000) * Number($("speed").value);
  before = now;
  const steps = Math.floor(owed / dt() + 1e-6);
  if (steps < 1) return;
  owed -= steps * dt();
  state.row = Math.min(longest() - 1, state.row + steps);
  if (state.row >= longest() - 1) play(false); else draw();
}

function play(on) {
  if (on && state.row >= longest() - 1) state.row = 0;
  state.playing = on;
  clearInterval(timer);
  if (on) { before = performance.now(); owed = 0; timer = setInterval(tick, 25); }
  draw();
}

function toTheEnd() {
  const [run, episode] = shown()[0];
  state.row = Math.max(0, count(run, episode) - 1 - Math.round(2 / dt()));
  draw();
}

// --- curves -------------------------------------------------------------------------------------

const PANELS = { collision_rate: ["collision rate", 1], frozen_rate: ["frozen rate", 1], success_rate: ["success rate", 1],
  return: ["return of an episode", 0], cost_return: ["cost of an episode", 0], lagrange_multiplier: ["multiplier", 0],
  intervention_rate: ["interventions of the projector", 1] };
const PALETTE = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#882255", "#332288", "#4f4111", "#8c4d47"];

window.onreport = () => {
  if (!$("curves") || !window.Plotly) return;
  const names = [...new Set(DATA.curves.flatMap((panel) => panel.systems.map((s) => s.name)))];
  const ink = colour("ink"), line = colour("line"), columns = $("curves").clientWidth < 700 ? 1 : 2;
  const rows = Math.ceil(DATA.curves.length / columns), traces = [];
  const layout = { grid: { rows, columns, pattern: "independent", ygap: 0.28, xgap: 0.12 }, height: 300 * rows + 60, margin: { l: 55, r: 10, t: 30, b: 45 },
    paper_bgcolor: colour("ground"), plot_bgcolor: colour("ground"), font: { color: ink, size: 12 }, legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
    hovermode: "x unified", annotations: [] };
  DATA.curves.forEach((panel, place) => {
    const end = place ? String(place + 1) : "", [title, rate] = PANELS[panel.figure] || [panel.figure, 0];
    layout[`xaxis${end}`] = { gridcolor: line, zeroline: false, title: { text: "frames", standoff: 4 } };
    layout[`yaxis${end}`] = { gridcolor: line, zeroline: false, title: { text: title }, ...(rate ? { tickformat: ".0%", rangemode: "tozero" } : {}) };
    panel.systems.forEach((s) => {
      const tint = PALETTE[names.indexOf(s.name) % PALETTE.length], axes = { xaxis: `x${end}`, yaxis: `y${end}`, legendgroup: s.name };
      if (s.low.some((v) => v !== null)) traces.push({ ...axes, x: [...s.frames, ...s.frames.slice().reverse()], y: [...s.high, ...s.low.slice().reverse()],
        fill: "toself", fillcolor: `${tint}2a`, line: { width: 0 }, hoverinfo: "skip", showlegend: false, type: "scatter", mode: "lines" });
      traces.push({ ...axes, x: s.frames, y: s.mean, name: s.name, mode: "lines", line: { color: tint, width: 2 }, showlegend: !traces.some((t) => t.name === s.name) });
    });
  });
  Plotly.react($("curves"), traces, layout, { displaylogo: false, responsive: true });
};

// --- addresses ----------------------------------------------------------------------------------

function address() {
  const run = DATA.runs[state.run];
  const parts = { run: state.run, seed: run.episodes.seed[state.episode], t: (state.row * dt()).toFixed(2) };
  if (state.other >= 0) parts.beside = state.other;
  return `#replay?${new URLSearchParams(parts)}`;
}

function show(what) {
  $("report").hidden = what !== "report";
  $("replay").hidden = what !== "replay";
  $("show-report").setAttribute("aria-current", String(what === "report"));
  $("show-replay").setAttribute("aria-current", String(what === "replay"));
  if (what === "replay") choose({}); else if (window.onreport) window.onreport();
}

function follow() {
  const [what, query] = location.hash.slice(1).split("?");
  const asked = new URLSearchParams(query || "");
  const within = (value, least) => { const n = Number(value ?? least); return Number.isInteger(n) && n >= least && n < DATA.runs.length ? n : least; };
  if (DATA.runs.length) {
    state.run = within(asked.get("run"), 0);
    state.other = within(asked.get("beside"), -1);
    const found = DATA.runs[state.run].episodes.seed.indexOf(Number(asked.get("seed")));
    if (found >= 0) { state.episode = found; $("task").value = ""; $("outcome").value = ""; } else state.episode = 0;
    if (asked.has("t")) state.row = Math.max(0, Math.round(Number(asked.get("t")) / dt()) || 0);
  }
  const empty = !$("report").textContent.trim();
  show(DATA.runs.length && (what === "replay" || empty) ? "replay" : "report");
}

async function start() {
  await Promise.all(DATA.runs.map(unpack));
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = (theme) => { document.documentElement.dataset.theme = theme; if (!$("replay").hidden) draw(); else if (window.onreport) window.onreport(); };
  $("theme").addEventListener("click", () => paint(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
  dark.addEventListener("change", () => paint(dark.matches ? "dark" : "light"));
  document.documentElement.dataset.theme = dark.matches ? "dark" : "light";
  options($("task"), [["", "all"], ...[...new Set(Object.values(TASK_OF))].map((t) => [t, t])], "");
  options($("outcome"), [["", "all"], ["crash", "a crash"], ...Object.entries(ENDS)], "");
  $("show-replay").hidden = !DATA.runs.length;
  $("show-report").hidden = !$("report").textContent.trim();
  $("show-report").addEventListener("click", () => { play(false); history.replaceState(null, "", "#report"); show("report"); });
  $("show-replay").addEventListener("click", () => { history.replaceState(null, "", "#replay"); show("replay"); });
  $("run").addEventListener("change", () => choose({ run: DATA.runs.findIndex((r) => runName(r) === $("run").value), other: -1, row: 0 }));
  $("seed").addEventListener("change", () => choose({ run: Number($("seed").value), other: -1, row: 0 }));
  $("other").addEventListener("change", () => choose({ other: Number($("other").value) }));
  for (const id of ["task", "outcome"]) $(id).addEventListener("change", () => choose({ row: 0 }));
  $("episode").addEventListener("change", () => choose({ episode: Number($("episode").value), row: 0 }));
  $("back").addEventListener("click", () => step(-1));
  $("forth").addEventListener("click", () => step(1));
  $("play").addEventListener("click", () => play(!state.playing));
  $("end").addEventListener("click", toTheEnd);
  $("time").addEventListener("input", () => { state.row = Number($("time").value); draw(); });
  $("link").addEventListener("click", async () => {
    history.replaceState(null, "", address());
    try { await navigator.clipboard.writeText(location.href); $("link").textContent = "copied"; } catch { $("link").textContent = "in the address bar"; }
    setTimeout(() => ($("link").textContent = "link"), 1500);
  });
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  window.addEventListener("resize", () => { if (!$("replay").hidden) draw(); });
  window.addEventListener("hashchange", follow);
  document.addEventListener("keydown", (event) => {
    if ($("replay").hidden || event.target.matches?.("select") || event.ctrlKey || event.metaKey || event.altKey) return;
    const by = event.shiftKey ? Math.round(1 / dt()) : 1;
    const keys = { " ": () => play(!state.playing), ArrowRight: () => { state.row = Math.min(longest() - 1, state.row + by); draw(); },
      ArrowLeft: () => { state.row = Math.max(0, state.row - by); draw(); }, n: () => step(1), p: () => step(-1), c: toTheEnd };
    if (keys[event.key]) { event.preventDefault(); if (document.activeElement instanceof HTMLButtonElement) document.activeElement.blur(); keys[event.key](); }
  });
  follow();
  document.documentElement.dataset.ready = "true";
}
start();
