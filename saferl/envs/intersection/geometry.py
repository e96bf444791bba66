"""The intersection's shape: pavement, reference lines, rectangles.

World frame of highway-env: x right, y down, heading = atan2(dy, dx), metres and radians. The ego
vehicle comes from the south (large y) and drives towards -y. Every function takes any leading
batch dimensions and any floating dtype, and loops over no vehicle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

LANE_WIDTH = 4.0
ARM = 100.0
HALF_BOX = 15.0
CURB_RADIUS = 7.0
EXIT_DISTANCE = 25.0
LENGTH = 5.0
WIDTH = 2.0

TASKS = ("lt", "gs", "rt")
#: A route is a task and the lane it starts in: left turn from the inner lane, straight from the
#: inner or the outer lane, right turn from the outer lane.
ROUTES = ("lt", "gs_inner", "gs_outer", "rt")
ROUTES_OF_TASK = {"lt": (0,), "gs": (1, 2), "rt": (3,), "mixed": (0, 1, 2, 3)}
TASK_OF_ROUTE = (0, 1, 1, 2)

_NORTH = -math.pi / 2
_ROAD_END = HALF_BOX + ARM
_HALF_ROAD = 2 * LANE_WIDTH


def _line(x: float, segments: list[tuple[float, float]]) -> Tensor:
    """Chain (length, curvature) segments from the south end of the approach at ``x``."""
    rows, y, heading, start = [], _ROAD_END, _NORTH, 0.0
    for length, curvature in segments:
        rows.append([x, y, heading, curvature, length, start])
        angle = curvature * length
        chord = length * (math.sin(angle / 2) / (angle / 2) if angle else 1.0)
        x += chord * math.cos(heading + angle / 2)
        y += chord * math.sin(heading + angle / 2)
        heading += angle
        start += length
    return torch.tensor(rows, dtype=torch.float64)


def _turn(x: float, radius: float, sign: float) -> Tensor:
    arc = radius * math.pi / 4  # two halves, so that every line has four segments
    own = [(ARM, 0.0), (arc, sign / radius), (arc, sign / radius), (ARM, 0.0)]
    later = [(ARM + LANE_WIDTH, 0.0), *own[1:]]
    return torch.stack([_line(x, own), _line(x, later)])


def _straight(x: float, sign: float) -> Tensor:
    angle = 2 * math.atan(LANE_WIDTH / (2 * HALF_BOX))
    radius = HALF_BOX / math.sin(angle)
    own = [(ARM, 0.0), (HALF_BOX, 0.0), (HALF_BOX, 0.0), (ARM, 0.0)]
    shift = [
        (ARM, 0.0),
        (radius * angle, sign / radius),
        (radius * angle, -sign / radius),
        (ARM, 0.0),
    ]
    return torch.stack([_line(x, own), _line(x, shift)])


#: [route, line, segment, (x, y, heading, curvature, length, arc length at its start)]. Line 0 ends
#: in the route's own exit lane, line 1 in the other one.
_LINES = torch.stack(
    [
        _turn(LANE_WIDTH / 2, HALF_BOX + LANE_WIDTH / 2, -1.0),
        _straight(LANE_WIDTH / 2, 1.0),
        _straight(3 * LANE_WIDTH / 2, -1.0),
        _turn(3 * LANE_WIDTH / 2, HALF_BOX - 3 * LANE_WIDTH / 2, 1.0),
    ]
)
#: [route, target, (x, y)]: the middle of both exit lanes, 25 m past the box.
_TARGETS = torch.tensor(
    [
        [[-40.0, -2.0], [-40.0, -6.0]],
        [[2.0, -40.0], [6.0, -40.0]],
        [[2.0, -40.0], [6.0, -40.0]],
        [[40.0, 6.0], [40.0, 2.0]],
    ],
    dtype=torch.float64,
)
#: Unit vector along each route's exit arm.
_EXITS = torch.tensor([[-1.0, 0.0], [0.0, -1.0], [0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)


class Constants:
    """Constant tensors, cast once to each dtype and device (a dict, as torch.compile sees through it).

    Args:
        *tensors: what is constant.
    """

    def __init__(self, *tensors: Tensor):
        self.tensors = tensors
        self._cast: dict[tuple[torch.dtype, torch.device], tuple[Tensor, ...]] = {}

    def like(self, like: Tensor) -> tuple[Tensor, ...]:
        """The tensors in the dtype and on the device of ``like``."""
        key = (like.dtype, like.device)
        if key not in self._cast:
            self._cast[key] = tuple(
                t.to(device=like.device, dtype=like.dtype) for t in self.tensors
            )
        return self._cast[key]


_TABLES = Constants(_LINES, _TARGETS, _EXITS)


def columns(*parts: Tensor) -> Tensor:
    """Stack parts [...] along a new last dimension that comes first in memory.

    A vehicle's numbers then lie as far apart as there are scenes, and the same number of all scenes
    side by side, which is how vector units like to read them.

    >>> columns(torch.zeros(3), torch.ones(3)).stride()
    (1, 3)
    """
    return torch.stack(parts).movedim(0, -1)


def wrap(angle: Tensor) -> Tensor:
    """Angle difference folded into [-pi, pi), radians."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def reference_lines(route: Tensor, like: Tensor) -> Tensor:
    """Both reference lines of a route: [..., 2, 4, 6], see :func:`line_pose`.

    ``route`` [...] int64 indexes :data:`ROUTES`; ``like`` gives dtype and device.
    """
    lines = _TABLES.like(like)[0].movedim(0, -1)[..., route]  # scenes side by side in memory
    return lines.movedim((0, 1, 2), (-3, -2, -1))


def target_points(route: Tensor, like: Tensor) -> Tensor:
    """The two target points [..., 2, 2] in metres: middles of the exit lanes, 25 m past the box."""
    return _TABLES.like(like)[1][route]


def _advance(segment: tuple[Tensor, ...], s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pose (x, y, heading) at arc length ``s`` from the start of constant-curvature segments."""
    x, y, heading, curvature = segment[:4]
    half = curvature * s / 2
    chord = s * torch.special.sinc(half / math.pi)
    return (
        x + chord * torch.cos(heading + half),
        y + chord * torch.sin(heading + half),
        heading + 2 * half,
    )


def line_pose(lines: Tensor, s: Tensor) -> Tensor:
    """Pose [..., 3] (x, y, heading) at arc length ``s`` [...] of ``lines`` [..., 4, 6].

    Before its start and past its end a line goes on straight.

    >>> lines = reference_lines(torch.tensor(0), torch.zeros(1))  # left turn, both lines
    >>> line_pose(lines, torch.tensor([90.0, 90.0]))[:, :2].round()
    tensor([[ 2., 25.],
            [ 2., 25.]])
    """
    starts = lines[..., 5]
    index = (s[..., None] >= starts[..., 1:]).sum(-1)[..., None, None]
    segment = lines.gather(-2, index.expand(*index.shape[:-1], 6)).squeeze(-2)
    return columns(*_advance(segment.unbind(-1), s - segment[..., 5]))


def project(position: Tensor, lines: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Nearest point of each line to a position.

    Args:
        position: [..., 2] metres, broadcast against the lines' leading dimensions.
        lines: [..., 4, 6].

    Returns:
        Pose of the nearest point [..., 3], its arc length [...] and its distance [...], metres.
    """
    # The four segments come first here.
    x, y, heading, curvature, length, start = lines.movedim(-2, 0).unbind(-1)
    dx, dy = position[..., 0] - x, position[..., 1] - y
    cos, sin = torch.cos(heading), torch.sin(heading)
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    bent = curvature != 0
    k = torch.where(bent, curvature, 1.0)
    # Angle at the arc's centre, from its start, in the direction of travel.
    angle = torch.atan2(along, k.abs().reciprocal() - across * k.sign())
    s = torch.where(bent, angle / k.abs(), along)
    s = torch.minimum(s.clamp_min(0.0), length)
    pose = _advance((x, y, heading, curvature), s)
    gap = torch.hypot(position[..., 0] - pose[0], position[..., 1] - pose[1])
    number = torch.arange(4, device=gap.device).reshape(4, *[1] * (gap.ndim - 1))
    nearest = number == gap.argmin(0)

    def pick(value: Tensor) -> Tensor:
        return torch.where(nearest, value, 0.0).sum(0)

    return columns(*(pick(part) for part in pose)), pick(s + start), gap.amin(0)


def corners(pose: Tensor, length: float = LENGTH, width: float = WIDTH) -> Tensor:
    """Corner points [..., 4, 2] of rectangles at ``pose`` [..., 3] (x, y, heading)."""
    cos, sin = torch.cos(pose[..., 2]), torch.sin(pose[..., 2])
    forward = torch.stack([cos, sin], -1) * (length / 2)
    left = torch.stack([-sin, cos], -1) * (width / 2)
    centre = pose[..., :2]
    return torch.stack(
        [centre + forward + left, centre + forward - left,
         centre - forward - left, centre - forward + left],
        -2,
    )  # fmt: skip


class Frame(NamedTuple):
    """Poses with the cosine and sine of their headings, each [...]."""

    x: Tensor
    y: Tensor
    cos: Tensor
    sin: Tensor

    def at(self, index) -> Frame:
        """Some of the frames, or with more dimensions, as by indexing a tensor."""
        return Frame(*(field[index] for field in tuple(self)))


def frame(x: Tensor, y: Tensor, heading: Tensor) -> Frame:
    """Frames [...] of poses given by their parts, each [...]."""
    return Frame(x, y, torch.cos(heading), torch.sin(heading))


def separation(
    a: Frame,
    b: Frame,
    size_a: tuple[float, float] = (LENGTH, WIDTH),
    size_b: tuple[float, float] = (LENGTH, WIDTH),
    scale: Tensor | float = 1.0,
) -> Tensor:
    """How far apart two rectangles are along the axis that separates them best, m; <= 0: they overlap.

    A number rather than a yes or no: minima of numbers over many pairs are quicker than ``any``.

    Args:
        a, b: frames [...], broadcast against each other.
        size_a, size_b: (length, width) in metres.
        scale: enlarges both rectangles, broadcast against the frames.
    """
    dx, dy = b.x - a.x, b.y - a.y
    cos, sin = (a.cos * b.cos + a.sin * b.sin).abs(), (a.sin * b.cos - a.cos * b.sin).abs()
    (la, wa), (lb, wb) = ([side * scale / 2 for side in size] for size in (size_a, size_b))

    def apart(c, s, l0, w0, l1, w1) -> Tensor:
        along, across = (dx * c + dy * s).abs(), (dy * c - dx * s).abs()
        return torch.maximum(
            along - (l0 + l1 * cos + w1 * sin), across - (w0 + l1 * sin + w1 * cos)
        )

    return torch.maximum(apart(a.cos, a.sin, la, wa, lb, wb), apart(b.cos, b.sin, lb, wb, la, wa))


def rectangle_distance(pose_a: Tensor, pose_b: Tensor) -> Tensor:
    """Distance of the bodies of two vehicles at poses [..., 3], m; 0 where they overlap.

    Of two rectangles that do not overlap a corner of one is nearest to the other.

    >>> ahead = torch.tensor([8.0, 5.0, 0.0])  # 3 m before the bumper, 3 m beside the flank
    >>> round(rectangle_distance(torch.zeros(3), ahead).item(), 3)
    4.243
    """

    def from_corners(poses: Tensor, pose: Tensor) -> Tensor:
        offset = corners(poses) - pose[..., None, :2]
        cos, sin = torch.cos(pose[..., 2:]), torch.sin(pose[..., 2:])
        along = (offset[..., 0] * cos + offset[..., 1] * sin).abs() - LENGTH / 2
        across = (offset[..., 1] * cos - offset[..., 0] * sin).abs() - WIDTH / 2
        return torch.hypot(along.clamp_min(0.0), across.clamp_min(0.0)).amin(-1)

    apart = torch.minimum(from_corners(pose_a, pose_b), from_corners(pose_b, pose_a))
    return torch.where(overlap(pose_a, pose_b), 0.0, apart)


def overlap(
    pose_a: Tensor,
    pose_b: Tensor,
    size_a: tuple[float, float] = (LENGTH, WIDTH),
    size_b: tuple[float, float] = (LENGTH, WIDTH),
    scale: Tensor | float = 1.0,
) -> Tensor:
    """Whether two rectangles overlap, by the separating axis theorem (touching counts).

    Args:
        pose_a, pose_b: [..., 3] (x, y, heading), broadcast against each other.
        size_a, size_b: (length, width) in metres.
        scale: enlarges both rectangles, broadcast against the poses' leading dimensions.

    Returns:
        bool [...].
    """
    a, b = (frame(*pose.unbind(-1)) for pose in (pose_a, pose_b))
    return separation(a, b, size_a, size_b, scale) <= 0


def on_pavement(points: Tensor) -> Tensor:
    """Whether points [..., 2] lie on the paved cross, its rounded corners included: bool [...]."""
    ax, ay = points[..., 0].abs(), points[..., 1].abs()
    arms = (torch.minimum(ax, ay) <= _HALF_ROAD) & (torch.maximum(ax, ay) <= _ROAD_END)
    box = torch.maximum(ax, ay) <= HALF_BOX
    return arms | (box & (torch.hypot(HALF_BOX - ax, HALF_BOX - ay) >= CURB_RADIUS))


def offroad(state: Tensor) -> Tensor:
    """Whether a corner of the vehicle with ``state`` [..., 6] has left the pavement: bool [...]."""
    x, y, heading = state[..., 0], state[..., 1], state[..., 4]
    cos, sin = torch.cos(heading), torch.sin(heading)
    inside = [
        on_pavement(columns(x + forward * cos - left * sin, y + forward * sin + left * cos))
        for forward in (-LENGTH / 2, LENGTH / 2)
        for left in (-WIDTH / 2, WIDTH / 2)
    ]
    return ~torch.stack(inside).all(0)


def arrived(state: Tensor, route: Tensor) -> Tensor:
    """Whether the vehicle is past 25 m on its exit arm, within one of its two lanes: bool [...]."""
    exits = _TABLES.like(state)[2][route]
    along = state[..., 0] * exits[..., 0] + state[..., 1] * exits[..., 1]
    right = state[..., 1] * exits[..., 0] - state[..., 0] * exits[..., 1]
    return (along >= HALF_BOX + EXIT_DISTANCE) & (right >= 0) & (right <= _HALF_ROAD)
