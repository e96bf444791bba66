"""The HTML file in a browser: it loads, plays, filters, jumps, and says nothing wrong."""

from __future__ import annotations

import base64
import gzip
import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.envs.intersection.true_scene import TrueScene
from saferl.evaluation.crashes import way
from saferl.evaluation.play import evaluate
from saferl.evaluation.trace import Trace, record
from saferl.report.player import NOTHING, SCALES, packed, page

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
needs_browser = pytest.mark.skipif(
    not BROWSER and "CI" not in os.environ, reason="there is no Chromium here"
)


@pytest.fixture(scope="module")
def traces() -> list[Trace]:
    """The blind and the cautious driver in the same twelve episodes."""
    scenario = Scenario(task="mixed").as_test()
    found = []
    for name, driver in (("blind", Driver()), ("<b>cautious</b>", CautiousDriver())):
        rows = evaluate(driver, BatchedIntersection(scenario, 12), 12, 5, False)
        env = TransformedEnv(BatchedIntersection(scenario, 12), TrueScene())
        found.append(record(driver, env, rows, policy=name))
    return found


def test_numbers_come_back_from_the_page(traces):
    """Decoded as the page does, in another language."""
    trace = traces[0]
    held = packed(trace)
    table = np.frombuffer(gzip.decompress(base64.b64decode(held["data"])), "<i2")
    table = table.reshape(-1, held["rows"]).cumsum(1, dtype=np.int16)
    assert held["rows"] == len(trace.rows["ego"])
    column = 0
    for name, shape, scales in held["layout"]:
        size = int(np.prod(shape))
        values = table[column : column + size].T.astype(float)
        values[values == NOTHING] = np.nan
        values = values.reshape(-1, *shape) / np.array(scales if shape else scales[0])
        own = trace.rows[name].astype(float)
        if name in ("ego", "vehicles"):
            values[..., 4], own = np.cos(values[..., 4]), own.copy()
            own[..., 4] = np.cos(own[..., 4])
        np.testing.assert_allclose(values, own, atol=0.51 / np.min(SCALES[name]), equal_nan=True)
        column += size
    assert column == len(table)
    assert json.loads(json.dumps(held)) == held
    for number in np.unique(trace.rows["vehicle_route"]):
        assert held["ways"][str(number)] == way(int(number))


def test_a_number_that_is_large_is_drawn_as_large(traces):
    """A dear crash: 16 bits hold it, in coarser steps."""
    rows = {**traces[0].rows, "cost": traces[0].rows["cost"] * 1000}
    held = packed(replace(traces[0], rows=rows))
    table = np.frombuffer(gzip.decompress(base64.b64decode(held["data"])), "<i2")
    table = table.reshape(-1, held["rows"]).cumsum(1, dtype=np.int16)
    sizes = [int(np.prod(shape)) for _, shape, _ in held["layout"]]
    place = [name for name, _, _ in held["layout"]].index("cost")
    (scale,) = held["layout"][place][2]
    assert table[sum(sizes[:place])].max() / scale == pytest.approx(
        np.nanmax(rows["cost"]), rel=1e-3
    )


def test_five_hundred_episodes_stay_small(traces):
    """Twelve of them, times 42, with a browser's four letters for three bytes."""
    size = len(packed(traces[0])["data"]) * 500 / 12
    assert size < 15e6, size


#: Does what a visitor does, and writes what it sees where the test can read it.
VISITOR = """
const wrong = [], seen = {};
window.addEventListener("error", (e) => wrong.push(String(e.message)));
window.addEventListener("unhandledrejection", (e) => wrong.push(String(e.reason)));
console.error = (...words) => wrong.push(words.join(" "));
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const pick = (id, value) => { $(id).value = value; $(id).dispatchEvent(new Event("change")); };
const key = (key, shiftKey = false) => document.body.dispatchEvent(new KeyboardEvent("keydown", { key, shiftKey, bubbles: true }));
const painted = () => { const c = document.querySelector("#scenes canvas"), d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
  let sum = 0; for (let i = 0; i < d.length; i += 97) sum = (sum * 31 + d[i]) % 1000003; return sum; };
window.addEventListener("load", async () => {
  for (let i = 0; i < 100 && !document.documentElement.dataset.ready; i++) await wait(20);
  seen.runs = [...$("run").options].map((o) => o.text);
  seen.hidden = [$("report").hidden, $("replay").hidden];
  seen.row = state.row;
  seen.all = $("episode").options.length;
  const before = painted();
  key("ArrowRight"); key("ArrowRight", true);
  seen.stepped = state.row - seen.row;
  seen.moved = painted() !== before;
  pick("outcome", "crash");
  seen.crashes = [...$("episode").options].map((o) => o.text);
  pick("task", "left turn");
  seen.left = $("episode").options.length;
  pick("task", ""); key("c");
  seen.beforeTheEnd = longest() - 1 - state.row;
  pick("other", "1");
  seen.scenes = document.querySelectorAll("#scenes canvas").length;
  seen.captions = [...document.querySelectorAll("#scenes figcaption")].map((f) => f.textContent);
  seen.address = address();
  const [first] = [state.episode];
  key("n"); seen.other = state.episode !== first; key("p"); seen.again = state.episode === first;
  state.row = 0; $("speed").value = "4"; key(" ");
  await wait(600);
  seen.played = state.row; seen.playing = state.playing; key(" ");
  seen.words = $("now").textContent;
  $("theme").click(); seen.theme = document.documentElement.dataset.theme; $("theme").click();
  const box = document.querySelector("#charts canvas").getBoundingClientRect();
  document.querySelector("#charts canvas").dispatchEvent(new MouseEvent("click", { clientX: box.left + 34 + (box.width - 40) / 2, clientY: box.top + 5 }));
  seen.middle = Math.abs(state.row - (longest() - 1) / 2) <= 1;
  seen.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  seen.wrong = wrong;
  const out = document.createElement("pre"); out.id = "seen"; out.textContent = JSON.stringify(seen); document.body.append(out);
});
"""


def visit(path: Path, where: str = "", size: str = "1280,900") -> dict:
    """What the visitor in a page has seen."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"]
    flags += [
        "--disable-background-networking",
        "--disable-component-update",
        f"--window-size={size}",
    ]
    command = [
        BROWSER,
        *flags,
        f"--user-data-dir={path.parent / 'profile'}",
        "--virtual-time-budget=20000",
    ]
    done = subprocess.run(
        [*command, "--dump-dom", f"file://{path}{where}"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    found = re.search(r'<pre id="seen">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:] + done.stdout[-500:]
    return json.loads(found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))


@needs_browser
@pytest.mark.parametrize("size", ["1280,900", "500,900"])
def test_a_visitor_plays_filters_and_jumps(traces, tmp_path: Path, size: str):
    path = tmp_path / "page.html"
    path.write_text(page("A <title>", "", traces, scripts=[VISITOR]), encoding="utf-8")
    trace = traces[0]
    number = 3
    seed = int(trace.episodes["seed"][number])
    seen = visit(path, f"#replay?run=0&seed={seed}&t=1.5", size)
    assert seen["wrong"] == []
    assert seen["runs"] == ["blind driver", "<b>cautious</b>"] and seen["hidden"] == [True, False]
    assert seen["row"] == 15 and seen["all"] == 12 and seen["stepped"] == 11 and seen["moved"]
    crash = np.isin(trace.episodes["outcome"], ("hit_vehicle", "left_road"))
    assert len(seen["crashes"]) == crash.sum() > 0
    assert seen["left"] == (crash & (trace.episodes["route"] == "lt")).sum()
    assert seen["beforeTheEnd"] == 20 and seen["scenes"] == 2
    assert (
        seen["captions"][0].startswith("blind driver: episode")
        and "hits a car" in seen["captions"][0]
    )
    assert seen["captions"][1].startswith("<b>cautious</b>: episode")  # a name, no markup
    assert re.fullmatch(r"#replay\?run=0&seed=\d+&t=[\d.]+&beside=1", seen["address"])
    assert seen["other"] and seen["again"] and seen["played"] > 5 and seen["playing"]
    assert "nearest: car" in seen["words"] and seen["middle"]
    assert seen["theme"] in ("light", "dark") and seen["wide"] <= 0


@needs_browser
def test_other_traffic_is_not_shown_beside(traces, tmp_path: Path):
    """The same seed with more cars on the road, or on another route, is another episode."""
    scenario = Scenario(task="mixed", scenario="dense").as_test()
    rows = evaluate(Driver(), BatchedIntersection(scenario, 3), 3, 5, False)
    env = TransformedEnv(BatchedIntersection(scenario, 3), TrueScene())
    dense = record(Driver(), env, rows, policy="blind")
    assert dense.episodes["seed"][0] == traces[0].episodes["seed"][0]
    path = tmp_path / "page.html"
    script = """window.addEventListener("load", () => setTimeout(() => { const out = document.createElement("pre"); out.id = "seen";
      out.textContent = JSON.stringify([...document.querySelectorAll("#scenes figcaption")].map((f) => f.textContent)); document.body.append(out); }, 500));"""
    path.write_text(page("", "", [traces[0], traces[1], dense], scripts=[script]), encoding="utf-8")
    where = f"#replay?run=0&seed={dense.episodes['seed'][0]}&beside="
    mine, same = visit(path, f"{where}1")
    assert mine.startswith("blind driver, nominal: episode 0") and "episode 0" in same
    assert (
        visit(path, f"{where}2")[1]
        == "blind driver, dense: it has not played this episode in this traffic"
    )


@needs_browser
def test_a_page_without_traces_shows_its_report(tmp_path: Path):
    path = tmp_path / "page.html"
    script = """window.addEventListener("load", () => setTimeout(() => { const out = document.createElement("pre");
      out.id = "seen"; out.textContent = JSON.stringify([$("report").hidden, $("show-replay").hidden]); document.body.append(out); }, 300));"""
    path.write_text(page("Report", "<p>Tables.</p>", [], scripts=[script]), encoding="utf-8")
    assert visit(path) == [False, True]


def test_a_name_ends_no_script(traces):
    html = page("</title><script>x", "", [], note="</script><script>alert(1)//")
    assert html.count("<script>") == 2 and "&lt;/title&gt;" in html
