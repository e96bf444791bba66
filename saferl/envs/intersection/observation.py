"""What the ego observes of itself and of the vehicles around it, in two forms.

``world`` is the paper's: coordinates on the map. ``route`` says the same along the ego's own route, from
which a network learns many times faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import (
    ARM,
    LENGTH,
    ROUTES,
    WIDTH,
    columns,
    line_pose,
    project,
    reference_lines,
    target_points,
    wrap,
)
from saferl.envs.ports import Feature

AHEAD = 70.0  # m along the ego's heading
BEHIND = 30.0
ROWS = 11
#: How far ahead along the line, and for how long, a vehicle's way is followed: m, s.
REACH, PATIENCE = 40.0, 8.0
_SPACING = 2.5  # m between the points of the line that it may cross
_CORRIDOR = 2.5  # m to either side of its way
#: For how long both are played on, and in what steps, to find when they are closest: s.
HORIZON, _STEP = 4.0, 0.25
_TURNING = 0.05  # rad/s, of a vehicle that turns
_RADIUS = math.hypot(LENGTH / 4, WIDTH / 2)
#: The seam of a vehicle's heading is on no lane's direction.
_SEAM = 0.75 * math.pi


@dataclass(frozen=True)
class Form:
    """The features of an observation, with the fixed scales that a network divides them by.

    Attributes:
        ego: of the ego, by name.
        vehicle: of a vehicle's row, likewise; the first says whether there is one.
    """

    ego: dict[str, Feature]
    vehicle: dict[str, Feature]

    @property
    def scales(self) -> dict[str, tuple[float, ...]]:
        """What the encoders of :mod:`saferl.modules` are given as ``ego_scale`` and ``vehicle_scale``."""
        return {
            "ego_scale": tuple(each.scale for each in self.ego.values()),
            "vehicle_scale": tuple(each.scale for each in self.vehicle.values()),
        }


_V_X = Feature(10.0, "m/s", low=0.0, says="forwards")
_V_Y = Feature(2.0, "m/s", says="to the right")
_OMEGA = Feature(1.0, "rad/s", says="yaw rate, clockwise")
_D_VEH = Feature(
    20.0, "m", low=-2 * _RADIUS, says="gap to the nearest vehicle; 70 where none is seen"
)
_D_DES = Feature(50.0, "m", low=0.0, says="Manhattan distance to the nearer target point")
_PRESENT = Feature(1.0, low=0.0, high=1.0, says="1 where the row is a vehicle, else all of it is 0")
FORMS = {
    "route": Form(
        ego={
            "v_x": _V_X, "v_y": _V_Y, "omega": _OMEGA,
            "offset": Feature(2.0, "m", says="to the right of its line"),
            "heading": Feature(0.5, "rad", -math.pi, math.pi, "against the line's"),
            "s": Feature(20.0, "m", says="along the line, 0 at the box"),
            **{name: Feature(1.0, low=0.0, high=1.0, says="whether this is its route") for name in ROUTES},
            "d_veh": _D_VEH, "d_des": _D_DES,
        },
        vehicle={
            "present": _PRESENT,
            "x": Feature(20.0, "m", -BEHIND, AHEAD, "ahead of the ego"),
            "y": Feature(20.0, "m", says="to the ego's right"),
            "v_x": Feature(10.0, "m/s", says="along the ego's heading, relative to the ego's"),
            "v_y": Feature(10.0, "m/s", says="to the ego's right, likewise"),
            "sin": Feature(1.0, "", -1.0, 1.0, "of its heading against the ego's"),
            "cos": Feature(1.0, "", -1.0, 1.0, "likewise"),
            "conflict_s": Feature(20.0, "m", 0.0, REACH, "along the ego's line to where its way first meets it"),
            "conflict_t": Feature(4.0, "s", 0.0, PATIENCE, "until it is there"),
            "lead": Feature(4.0, "s", -PATIENCE, PATIENCE, "that the ego is there later"),
            "closest": Feature(10.0, "m", low=0.0, says="between both centres when they are closest, at their speeds and turns of now"),
            "closest_t": Feature(4.0, "s", 0.0, HORIZON, "until then"),
        },
    ),
    "world": Form(
        ego={
            "present": Feature(1.0, low=1.0, high=1.0),
            "x": Feature(10.0, "m", says="of the map, to the east"), "y": Feature(10.0, "m", says="of the map, to the south"),
            "v_x": _V_X, "v_y": _V_Y,
            "phi": Feature(1.0, "rad", says="heading, clockwise from x; not folded"),
            "omega": _OMEGA, "d_veh": _D_VEH, "d_des": _D_DES,
        },
        vehicle={
            "present": _PRESENT,
            "x": Feature(20.0, "m", says="from the ego, along the map's x"), "y": Feature(20.0, "m", says="along its y"),
            "v_x": Feature(10.0, "m/s", says="relative to the ego's, along the map's x"), "v_y": Feature(10.0, "m/s", says="along its y"),
            "phi": Feature(1.0, "rad", -_SEAM, 2 * math.pi - _SEAM, "heading"),
        },
    ),
}  # fmt: skip
_BY_WIDTH = {len(form.ego): form for form in FORMS.values()}


def reading(ego: Tensor, name: str) -> Tensor:
    """A feature [...] of the ego's [..., F] by its name; F says which form they are of.

    >>> reading(torch.arange(9.0), "v_x")
    tensor(3.)
    """
    return ego[..., list(_BY_WIDTH[ego.shape[-1]].ego).index(name)]


def _circles(state: Tensor) -> tuple[Tensor, Tensor]:
    """Centres x, y, each [2, ...], of the two circles that stand for a vehicle."""
    along, across = (LENGTH / 4 * f(state[..., 4]) for f in (torch.cos, torch.sin))
    x, y = state[..., 0], state[..., 1]
    return torch.stack([x + along, x - along]), torch.stack([y + across, y - across])


def vehicle_distance(ego: Tensor, vehicles: Tensor, observed: Tensor) -> Tensor:
    """d_veh [...], metres: smallest gap between the ego's two circles and any observed vehicle's.

    Args:
        ego: [..., 6].
        vehicles: [..., N, 6].
        observed: bool [..., N]; with none observed the distance is 70 m.
    """
    (x, y), (own_x, own_y) = _circles(vehicles.movedim(-2, 0)), _circles(ego)
    observed = observed.movedim(-1, 0)
    gap = torch.hypot(x - own_x[:, None, None], y - own_y[:, None, None]).amin((0, 1)) - 2 * _RADIUS
    gap = torch.where(observed, gap, torch.inf)
    none = torch.full_like(ego[..., 0], torch.inf)[None]  # also where there is no vehicle at all
    return torch.where(observed.any(0), torch.cat([gap, none]).amin(0), AHEAD)


def destination_distance(ego: Tensor, route: Tensor) -> Tensor:
    """d_des [...], metres: smallest Manhattan distance to the two target points."""
    return (target_points(route, ego) - ego[..., None, :2]).abs().sum(-1).amin(-1)


def _conflict(
    x: Tensor, y: Tensor, cos: Tensor, sin: Tensor, speed: Tensor, line: Tensor, s: Tensor
) -> tuple[Tensor, Tensor]:
    """Where and when vehicles that go straight on first meet the line ahead of the ego.

    Args:
        x, y, cos, sin, speed: of the vehicles, [N, ...].
        line: [..., 4, 6].
        s: arc length of the ego along it [...].

    Returns:
        Metres along the line and seconds, [N, ...]; :data:`REACH` and :data:`PATIENCE` where they do not.
    """
    steps = torch.arange(0.0, REACH, _SPACING, dtype=s.dtype, device=s.device)
    steps = steps.reshape(-1, *[1] * s.ndim)
    points = line_pose(line.expand(len(steps), *line.shape), s + steps)[:, None]  # [K, 1, ..., 3]
    dx, dy = points[..., 0] - x, points[..., 1] - y
    along, across = dx * cos + dy * sin, (dy * cos - dx * sin).abs()
    meets = (across < _CORRIDOR) & (along > -LENGTH / 2)
    where = torch.where(meets, steps[:, None], REACH)
    first = where.amin(0)
    time = ((along - LENGTH / 2) / speed.clamp_min(1.0)).clamp(0.0, PATIENCE)
    return first, torch.where(meets & (where == first), time, PATIENCE).amin(0)


def _closest(
    x: Tensor,
    y: Tensor,
    heading: Tensor,
    speed: Tensor,
    omega: Tensor,
    line: Tensor,
    s: Tensor,
    own: Tensor,
) -> tuple[Tensor, Tensor]:
    """How close vehicles come to an ego that follows its line at ``own`` m/s, and when.

    A vehicle that turns goes on turning until it drives along one of the arms, then straight on.

    Returns:
        Metres between centres and seconds, [N, ...].
    """
    times = torch.arange(0.0, HORIZON + _STEP, _STEP, dtype=s.dtype, device=s.device)
    times = times.reshape(-1, *[1] * s.ndim)
    points = line_pose(line.expand(len(times), *line.shape), s + own * times)[:, None]
    times = times[:, None]  # [K, 1, ...]
    # The rest of its turn, and the time that it takes.
    turned = torch.remainder(heading * omega.sign(), math.pi / 2)
    rest = torch.where(omega.abs() > _TURNING, math.pi / 2 - turned, 0.0)
    turning = torch.minimum(times, rest / omega.abs().clamp_min(_TURNING))
    half = 0.5 * omega * turning
    chord = speed * turning * torch.sinc(half / math.pi)
    straight, last = speed * (times - turning), heading + 2.0 * half
    path_x = x + chord * torch.cos(heading + half) + straight * torch.cos(last)
    path_y = y + chord * torch.sin(heading + half) + straight * torch.sin(last)
    gap = torch.hypot(points[..., 0] - path_x, points[..., 1] - path_y)
    least, when = gap.min(0)
    return least, when.to(s) * _STEP


def observe(
    ego: Tensor,
    vehicles: Tensor,
    present: Tensor,
    route: Tensor,
    rows: int = ROWS,
    form: str = "route",
) -> tuple[Tensor, Tensor, Tensor]:
    """The observation of the CMDP, in SI units.

    Args:
        ego: [..., 6].
        vehicles: [..., N, 6]; N may be 0.
        present: bool [..., N].
        route: int64 [...].
        rows: M; at most M - 1 vehicles are observed, one row is always padding.
        form: a name in :data:`FORMS`.

    Returns:
        ``ego`` [..., F] and ``vehicles`` [..., M, G], the features of the form, the vehicles nearest
        first, absent rows zero; and which of the N vehicles are observed, bool [..., N]. The last two
        features of the ego are ``d_veh`` and ``d_des`` in both forms. Of ``world``, a vehicle's heading
        lies in [-3 pi / 4, 5 pi / 4).

    Raises:
        ValueError: there is no such form.
    """
    if form not in FORMS:
        raise ValueError(f"form must be one of {', '.join(FORMS)}, got {form!r}.")
    # Vehicles come first here, [N, ...].
    x, y, v_x, v_y, heading, yaw_rate = vehicles.movedim(-2, 0).unbind(-1)
    own_x, own_y, own_v_x, own_v_y, phi, omega = ego.unbind(-1)
    cos, sin = torch.cos(phi), torch.sin(phi)
    dx, dy = x - own_x, y - own_y
    ahead = dx * cos + dy * sin
    seen = present.movedim(-1, 0) & (ahead <= AHEAD) & (ahead >= -BEHIND)

    # The row of each vehicle: how many are nearer.
    distance = torch.where(seen, torch.hypot(dx, dy), torch.inf)
    number = torch.arange(x.shape[0], device=x.device).reshape(-1, *[1] * (x.ndim - 1))
    tie = (distance[None] == distance[:, None]) & (number[None] < number[:, None])
    row = ((distance[None] < distance[:, None]) | tie).sum(1)
    seen = seen & (row < rows - 1)
    observed = seen.movedim(0, -1)
    nearest = vehicle_distance(ego, vehicles, observed)
    target = destination_distance(ego, route)

    v_cos, v_sin = torch.cos(heading), torch.sin(heading)
    if form == "world":
        own = [torch.ones_like(phi), own_x, own_y, own_v_x, own_v_y, phi, omega]
        features = [
            dx,
            dy,
            (v_x * v_cos - v_y * v_sin) - (own_v_x * cos - own_v_y * sin),
            (v_x * v_sin + v_y * v_cos) - (own_v_x * sin + own_v_y * cos),
            torch.remainder(heading + _SEAM, 2 * math.pi) - _SEAM,
        ]
    else:
        line = reference_lines(route, ego)[..., 0, :, :]
        pose, s, _ = project(ego[..., :2], line)
        line_cos, line_sin = torch.cos(pose[..., 2]), torch.sin(pose[..., 2])
        offset = (own_y - pose[..., 1]) * line_cos - (own_x - pose[..., 0]) * line_sin
        error = wrap(phi - pose[..., 2])
        routes = torch.arange(len(ROUTES), device=route.device).reshape(-1, *[1] * route.ndim)
        own = [own_v_x, own_v_y, omega, offset, error, s - ARM, *(route == routes).to(phi)]
        turn_cos, turn_sin = v_cos * cos + v_sin * sin, v_sin * cos - v_cos * sin
        features = [
            ahead,
            dy * cos - dx * sin,
            (v_x * turn_cos - v_y * turn_sin) - own_v_x,
            (v_x * turn_sin + v_y * turn_cos) - own_v_y,
            turn_sin,
            turn_cos,
        ]
        where, when = _conflict(x, y, v_cos, v_sin, v_x, line, s)
        lead = (where / own_v_x.clamp_min(1.0) - when).clamp(-PATIENCE, PATIENCE)
        close = _closest(x, y, heading, v_x, yaw_rate, line, s, own_v_x)
        features += [where, when, lead, *close]
    places = torch.arange(rows, device=x.device).reshape(-1, *[1] * x.ndim)
    here = (places == row) & seen  # [M, N, ...]
    features = [torch.ones_like(x), *features]
    table = torch.stack([torch.where(here, feature, 0.0).sum(1) for feature in features])
    return columns(*own, nearest, target), table.movedim((0, 1), (-1, -2)), observed


def as_world(ego: Tensor, vehicles: Tensor) -> tuple[Tensor, Tensor]:
    """An observation of either form as one of ``world``.

    Args:
        ego: [..., F].
        vehicles: [..., M, G].

    Returns:
        ``ego`` [..., 9] and ``vehicles`` [..., M, 6].
    """
    if _BY_WIDTH[ego.shape[-1]] is FORMS["world"]:
        return ego, vehicles
    own = dict(zip(FORMS["route"].ego, ego.unbind(-1), strict=True))
    route = torch.stack([own[name] for name in ROUTES], -1).argmax(-1)
    pose = line_pose(reference_lines(route, ego)[..., 0, :, :], own["s"] + ARM)
    x = pose[..., 0] - own["offset"] * torch.sin(pose[..., 2])
    y = pose[..., 1] + own["offset"] * torch.cos(pose[..., 2])
    phi, v_x, v_y = pose[..., 2] + own["heading"], own["v_x"], own["v_y"]
    world = [torch.ones_like(x), x, y, v_x, v_y, phi, own["omega"], own["d_veh"], own["d_des"]]

    row = dict(zip(FORMS["route"].vehicle, vehicles.unbind(-1), strict=True))
    cos, sin, angle = torch.cos(phi)[..., None], torch.sin(phi)[..., None], phi[..., None]
    heading = angle + torch.atan2(row["sin"], row["cos"])
    others = [
        row["x"] * cos - row["y"] * sin,
        row["x"] * sin + row["y"] * cos,
        row["v_x"] * cos - row["v_y"] * sin,
        row["v_x"] * sin + row["v_y"] * cos,
        torch.remainder(heading + _SEAM, 2 * math.pi) - _SEAM,
    ]
    there = row["present"] > 0
    others = [row["present"], *(torch.where(there, value, 0.0) for value in others)]
    return torch.stack(world, -1), torch.stack(others, -1)
