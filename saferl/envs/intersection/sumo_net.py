"""Our road as a network of SUMO, and its drivers.

SUMO's y points up and ours down; its lane 0 is the outer one and ours the inner one. Edges are ``in0`` to ``in3`` and
``out0`` to ``out3``, by the arm; the route of vehicles on our route r is called ``r``.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from saferl.envs.intersection.geometry import ARM, HALF_BOX, LANE_WIDTH, LENGTH, WIDTH
from saferl.envs.intersection.roads import (
    MOVEMENTS,
    PRIORITIES,
    SPEED_LIMIT,
    TURN_SPEED,
    lane_frames,
    lanes,
)

_END = HALF_BOX + ARM
_FAST = 50.0  # m/s, limit of the arms: every car keeps to the speed that it wants
_POINTS = 33  # of a bend
#: m/s^2 that others expect of the ego: they take it for going on as it does, as our rules do, and one that stands for
#: standing; with SUMO's 2.6 an oncoming car waits for ever for one that stands far before the box.
_STEADY = 0.01
#: By how many arms a movement goes on, clockwise.
_ARMS_ON = {"left": 1, "straight": 2, "right": 3}


@dataclass(frozen=True)
class Manners:
    """How SUMO's drivers drive; all else is SUMO's default (Krauss's model).

    Attributes:
        sigma: imperfection, 0 to 1: how much slower than they could they drive, at random, anew every second.
        heedless: share of drivers that go before those who have the right of way (``jmIgnoreFoeProb``); they still stop
            for who is in the box. Drawn by SUMO, beside those of ``task.traffic.heedless``.
    """

    sigma: float = 0.0
    heedless: float = 0.0


#: ``env.drivers``.
MANNERS = {
    "perfect": Manners(),
    "imperfect": Manners(sigma=0.5),
    "disobedient": Manners(sigma=0.5, heedless=0.5),
}
_HEEDLESS = {"jmIgnoreFoeProb": 1.0, "jmIgnoreFoeSpeed": _FAST}


def _tag(name: str, **attributes: object) -> str:
    said = "".join(f' {key.rstrip("_")}="{value}"' for key, value in attributes.items())
    return f"<{name}{said}/>"


def _through_the_box(route: int) -> str:
    """The middle line of a route through the box, as SUMO writes it."""
    lane = lanes(torch.tensor(route), torch.zeros(1, dtype=torch.float64))
    place, _ = lane_frames(lane, torch.linspace(ARM, float(lane.out), _POINTS).double())
    return " ".join(f"{x:.3f},{-y:.3f}" for x, y in zip(place.x, place.y, strict=True))


def plain() -> dict[str, str]:
    """Nodes, edges and connections as netconvert reads them, by the endings of their files' names.

    >>> plain()["edg"].count("<edge "), plain()["con"].count("<connection ")
    (8, 16)
    """
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    box = " ".join(f"{x * HALF_BOX},{y * HALF_BOX}" for x, y in corners)
    nodes = [_tag("node", id="box", x=0, y=0, type="priority", shape=box)]
    edges, connections = [], []
    for arm, priority in enumerate(PRIORITIES):
        # The direction of those who come in.
        lane = lanes(torch.tensor(4 * arm), torch.zeros((), dtype=torch.float64))
        x, y = round(-float(lane.cos)), round(float(lane.sin))
        outside, inside = (f"{size * x},{size * y}" for size in (_END, HALF_BOX))
        nodes.append(_tag("node", id=f"end{arm}", x=_END * x, y=_END * y, type="dead_end"))
        same = {"numLanes": 2, "width": LANE_WIDTH, "speed": _FAST, "priority": priority}
        for name, begin, end, shape in (
            ("in", f"end{arm}", "box", (outside, inside)),
            ("out", "box", f"end{arm}", (inside, outside)),
        ):
            edges.append(
                _tag("edge", id=f"{name}{arm}", from_=begin, to=end, shape=" ".join(shape), **same)
            )
    for route in range(4 * len(PRIORITIES)):
        movement, lane = MOVEMENTS[route % 4]
        begin, end = edges_of(route)
        connections.append(
            _tag("connection", from_=begin, to=end, fromLane=1 - lane, toLane=1 - lane, speed=TURN_SPEED[movement],
                 shape=_through_the_box(route))
        )  # fmt: skip
    groups = {"nod": ("nodes", nodes), "edg": ("edges", edges), "con": ("connections", connections)}
    return {
        ending: "\n".join([f"<{group}>", *lines, f"</{group}>"])
        for ending, (group, lines) in groups.items()
    }


def edges_of(route: int) -> tuple[str, str]:
    """The approach and the exit of one of our 16 routes.

    >>> edges_of(0), edges_of(4 * 3 + 3)  # from the south to the left, from the east to the right
    (('in0', 'out1'), ('in3', 'out2'))
    """
    arm, (movement, _) = route // 4, MOVEMENTS[route % 4]
    return f"in{arm}", f"out{(arm + _ARMS_ON[movement]) % 4}"


def cars(manners: Manners) -> str:
    """Routes, and the types of cars: ``car``, ``heedless``, and ``ego``, which the dynamics drive."""
    size = {"length": LENGTH, "width": WIDTH, "speedDev": 0, "vClass": "passenger"}
    usual = size | {"sigma": manners.sigma, "sigmaStep": 1}
    share = manners.heedless
    lines = [
        _tag("vType", id="obedient", probability=1 - share, **usual),
        _tag("vType", id="heedless", probability=share, **usual, **_HEEDLESS),
        _tag("vTypeDistribution", id="car", vTypes="obedient heedless"),
        _tag("vType", id="ego", maxSpeed=SPEED_LIMIT, accel=_STEADY, **size),
    ]
    for route in range(4 * len(PRIORITIES)):
        lines.append(_tag("route", id=route, edges=" ".join(edges_of(route))))
    return "\n".join(["<routes>", *lines, "</routes>"])


@cache
def _folder() -> TemporaryDirectory:
    """This process's own, gone when it ends."""
    return TemporaryDirectory(prefix="saferl-sumo-")


@cache
def network() -> Path:
    """The network, made once for each process.

    Raises:
        RuntimeError: netconvert failed.
    """
    import sumo  # pyright: ignore[reportMissingImports]  (an extra)

    folder = Path(_folder().name)
    for ending, text in plain().items():
        (folder / f"road.{ending}.xml").write_text(text)
    made = folder / "road.net.xml"
    kinds = {"node": "nod", "edge": "edg", "connection": "con"}
    files = [f"--{kind}-files={folder}/road.{ending}.xml" for kind, ending in kinds.items()]
    program = Path(sumo.SUMO_HOME, "bin", "netconvert")
    options = ("--offset.disable-normalization", "--no-turnarounds", "--precision=4")
    done = subprocess.run(
        [program, *files, *options, f"--output-file={made}"], capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"netconvert failed: {done.stderr.strip()}")
    return made


@cache
def traffic(drivers: str) -> Path:
    """The file of :func:`cars` for a name in :data:`MANNERS`."""
    path = Path(_folder().name) / f"{drivers}.rou.xml"
    path.write_text(cars(MANNERS[drivers]))
    return path
