"""The page that plays traces: one HTML file, no server, no network."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
import torch

from saferl.envs.intersection.geometry import (
    ARM,
    CURB_RADIUS,
    HALF_BOX,
    LANE_WIDTH,
    LENGTH,
    ROUTES,
    WIDTH,
    line_pose,
    reference_lines,
)
from saferl.evaluation.crashes import way
from saferl.evaluation.trace import Trace
from saferl.report.systems import LABELS

#: Columns of the rows of a trace, and how many of them make a unit, fewer where they would not fit: they are stored as 16-bit
#: integers.
SCALES = {
    "ego": (100, 100, 100, 100, 10_000, 1000),
    "vehicles": (100, 100, 100, 100, 10_000, 1000),
    "proposed": (1000, 10_000),
    "executed": (1000, 10_000),
    "members": 2000,
    "members_executed": 2000,
    "risk": 2000,
    "risk_executed": 2000,
    "attention": 10_000,
    "cost_share": 10_000,
    "cost": 10_000,
    "gap": 100,
    "nearest": 1,
    "observed": 1,
    "priority": 1,
    "vehicle_route": 1,
    "intervened": 1,
}
#: What stands for "not there".
NOTHING = -32768


def packed(trace: Trace) -> dict[str, Any]:
    """A trace for the page: numbers as 16-bit integers, column by column, each as the difference from the row before, zipped.

    Angles are folded to (-pi, pi].
    """
    trace = trace.worst()
    columns, layout = [], []
    for name, scale in SCALES.items():
        values = np.asarray(trace.rows[name], dtype=np.float64)
        shape = values.shape[1:]
        if isinstance(scale, tuple) and len(scale) == 6:  # a state's heading
            values = values.copy()
            values[..., 4] = np.remainder(values[..., 4] + np.pi, 2 * np.pi) - np.pi
        axes = tuple(range(values.ndim - np.ndim(scale)))
        most = np.nan_to_num(np.abs(values), posinf=0.0).max(axes, initial=1e-9)
        scale = np.minimum(scale, 32767 / most)
        scaled = np.round(values * scale).clip(-32767, 32767)
        whole = np.where(np.isnan(scaled), NOTHING, scaled).astype(np.int16)
        columns.append(whole.reshape(len(values), -1).T)
        layout.append([name, list(shape), np.atleast_1d(scale).tolist()])
    table = np.concatenate(columns)
    steps = np.diff(table, axis=1, prepend=np.int16(0))  # wraps, and so does their sum
    data = gzip.compress(steps.astype("<i2").tobytes(), 9, mtime=0)
    return {
        "about": {**trace.about, "label": _label(trace.about)},
        "episodes": {key: value.tolist() for key, value in trace.episodes.items()},
        "ways": {str(route): way(int(route)) for route in np.unique(trace.rows["vehicle_route"])},
        "layout": layout,
        "rows": len(table[0]),
        "data": base64.b64encode(data).decode(),
    }


def _label(about: Mapping[str, Any]) -> str:
    """What to call whoever drives."""
    name = str(about.get("algo", about.get("policy")))
    return LABELS.get(name, name)


def road() -> dict[str, Any]:
    """What the page draws the road from, m."""
    along = torch.linspace(ARM - 60.0, 2 * ARM, 160, dtype=torch.float64)
    lines = {}
    for number, name in enumerate(ROUTES):
        both = reference_lines(torch.tensor(number), torch.zeros(1, dtype=torch.float64))
        points = [line_pose(line.expand(len(along), 4, 6), along)[:, :2] for line in both]
        lines[name] = [each.numpy().round(2).tolist() for each in points]
    return {
        "arm": ARM, "box": HALF_BOX, "lane": LANE_WIDTH, "curb": CURB_RADIUS, "length": LENGTH, "width": WIDTH,
        "lines": lines,
    }  # fmt: skip


def page(
    title: str, body: str, traces: Sequence[Trace], *, scripts: Sequence[str] = (), **data: Any
) -> str:
    """The HTML of a report.

    Args:
        title: heads it.
        body: HTML of the tables and figures; may be empty.
        traces: what can be played.
        scripts: JavaScript that is put in whole.
        **data: what else the scripts read, as ``DATA.name``.
    """
    folder = files("saferl.report").joinpath("page")
    parts: Mapping[str, str] = {
        name: folder.joinpath(f"page.{name}").read_text(encoding="utf-8")
        for name in ("html", "css", "js")
    }
    held = {"road": road(), "runs": [packed(trace) for trace in traces], **data}
    # No name in the data ends the script in which it lies.
    text = json.dumps(held, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    fills = {
        "TITLE": escape(title),
        "CSS": parts["css"],
        "BODY": body,
        "DATA": text,
        "SCRIPTS": "".join(f"<script>{script}</script>\n" for script in scripts),
        "JS": parts["js"],
    }
    whole = parts["html"]
    for name, fill in fills.items():
        whole = whole.replace(f"<!--{name}-->", fill)
    return whole
