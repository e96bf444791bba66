"""The intersection as a road network of highway-env's lanes.

Nodes are named as in highway-env: ``o`` outer, ``ir`` end of an approach, ``il`` start of an exit,
then the arm (0 south, 1 west, 2 north, 3 east). On every road lane 0 is the inner and lane 1 the
outer one. The same routes as tensors are in :mod:`~saferl.envs.intersection.roads`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.road.lane import CircularLane, LineType, StraightLane
from highway_env.road.road import LaneIndex, RoadNetwork

from saferl.envs.intersection.geometry import ARM, HALF_BOX, LANE_WIDTH
from saferl.envs.intersection.roads import (
    LEFT_RADIUS,
    MOVEMENTS,
    PRIORITIES,
    RIGHT_RADIUS,
    SPEED_LIMIT,
    TURN_SPEED,
)

#: The lanes of each route in the network: approach, connector through the box, exit.
LANE_INDEXES: list[tuple[LaneIndex, LaneIndex, LaneIndex]] = [
    (
        (f"o{arm}", f"ir{arm}", lane),
        (f"ir{arm}", f"il{(arm + turn) % 4}", lane if turn == 2 else 0),
        (f"il{(arm + turn) % 4}", f"o{(arm + turn) % 4}", lane),
    )
    for arm in range(4)
    for turn, (_, lane) in zip((1, 2, 2, 3), MOVEMENTS, strict=True)
]


def build_network() -> RoadNetwork:
    """Four arms of two lanes each way, unsignalised, with highway-env's road priorities.

    The horizontal road has the right of way: priority 3 for its straight lanes and right turns, 2
    for its left turns, 1 for vertical straight lanes and right turns, 0 for vertical left turns.

    >>> sorted(build_network().graph["ir0"])  # from the south: to the west, the north, the east
    ['il1', 'il2', 'il3']
    """
    network = RoadNetwork()
    none, line, striped = LineType.NONE, LineType.CONTINUOUS, LineType.STRIPED
    blank: Any = (none, none)
    curb: Any = (none, line)
    end = HALF_BOX + ARM
    for arm in range(4):
        angle = np.pi / 2 * arm
        priority = PRIORITIES[arm]
        cos, sin = round(np.cos(angle)), round(np.sin(angle))
        rotation = np.array([[cos, -sin], [sin, cos]])
        node, left, ahead, right = (f"{arm}", *(f"il{(arm + k) % 4}" for k in (1, 2, 3)))

        def straight(start, stop, lines: Any, level=priority, rotation=rotation):
            return StraightLane(
                rotation @ np.array(start), rotation @ np.array(stop), line_types=lines,
                priority=level, speed_limit=SPEED_LIMIT,
            )  # fmt: skip

        for lane, x in enumerate((LANE_WIDTH / 2, 3 * LANE_WIDTH / 2)):
            edge = (line, striped) if lane == 0 else curb
            network.add_lane("o" + node, "ir" + node, straight((x, end), (x, HALF_BOX), edge))
            network.add_lane("ir" + node, ahead, straight((x, HALF_BOX), (x, -HALF_BOX), blank))
            # The exit of the arm itself, on the other side of its middle line.
            network.add_lane("il" + node, "o" + node, straight((-x, HALF_BOX), (-x, end), edge))
        network.add_lane(
            "ir" + node,
            left,
            CircularLane(
                rotation @ np.array([-HALF_BOX, HALF_BOX]), LEFT_RADIUS, angle, angle - np.pi / 2,
                clockwise=False, line_types=blank, priority=priority - 1,
                speed_limit=TURN_SPEED["left"],
            ),
        )  # fmt: skip
        network.add_lane(
            "ir" + node,
            right,
            CircularLane(
                rotation @ np.array([HALF_BOX, HALF_BOX]), RIGHT_RADIUS, angle + np.pi,
                angle + 1.5 * np.pi, line_types=curb, priority=priority,
                speed_limit=TURN_SPEED["right"],
            ),
        )  # fmt: skip
    return network
