"""The intersection with SUMO's drivers: a second world, in which nothing was trained.

The road, the ego and all that is observed, rewarded and paid are ours; SUMO decides how far along its lane each of the
other cars is, and how fast.
"""

from __future__ import annotations

import subprocess
import sys
import weakref
from collections.abc import Iterable
from importlib.util import find_spec
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from saferl.envs.intersection.base import OUTCOMES, ReplayedIntersection
from saferl.envs.intersection.batched import (
    State,
    TensorIntersection,
    advance,
    begin,
    vehicles_of,
)
from saferl.envs.intersection.dynamics import step_ego, to_physical
from saferl.envs.intersection.geometry import ARM, LENGTH
from saferl.envs.intersection.roads import MOVEMENTS, lane_project, lanes
from saferl.envs.intersection.scenario import SUBSTEPS, Scenario
from saferl.envs.intersection.sumo_net import MANNERS, network, traffic
from saferl.envs.intersection.sumo_worker import Car, Pose, Seen
from saferl.envs.intersection.traffic import Vehicles

_WORKER = Path(__file__).with_name("sumo_worker.py")


def installed() -> bool:
    """Whether the extra is there."""
    return all(find_spec(name) is not None for name in ("libsumo", "sumo"))


def poses(ego: Tensor) -> list[Pose]:
    """States [..., 6] of the ego as SUMO's poses: of its front bumper, y up, degrees clockwise from the north.

    >>> poses(torch.tensor([[2.0, 50.0, 9.0, 0.0, 0.0, 0.0]]))  # eastwards
    [(4.5, -50.0, 90.0)]
    """
    x, y, phi = ego[..., 0], ego[..., 1], ego[..., 4]
    front = x + LENGTH / 2 * torch.cos(phi), -(y + LENGTH / 2 * torch.sin(phi))
    columns = torch.stack([*front, 90.0 + torch.rad2deg(phi)], -1).tolist()
    return [(x, y, angle) for x, y, angle in columns]


def _entering(vehicles: Vehicles, joins: Tensor) -> list[tuple]:
    """Of the vehicles of one environment, each [N], those that enter, bool [N]."""
    return [
        tuple(
            Car(
                number=n,
                route=(route := int(vehicles.route[n])),
                lane=1 - MOVEMENTS[route % 4][1],
                front=min(float(vehicles.s[n]) + LENGTH / 2, ARM),
                speed=float(vehicles.speed[n]),
                wanted=float(vehicles.desired[n]),
                headway=float(vehicles.headway[n]),
                heedless=bool(vehicles.heedless[n]),
            )
        )
        for n in joins.nonzero().flatten().tolist()
    ]


def placed(vehicles: Vehicles, seen: list[Seen]) -> Vehicles:
    """Vehicles [N, K] where SUMO has them, in each of K environments."""
    table = np.full((len(seen), len(vehicles.s), 3), np.nan)
    for place, each in enumerate(seen):
        for number, *values in each:
            table[place, number] = values
    x, y, speed = torch.from_numpy(table).to(vehicles.s).movedim((0, 2), (2, 0))
    present = ~x.isnan()
    front, _ = lane_project(lanes(vehicles.route, vehicles.s), x, -y)
    return vehicles._replace(
        present=present,
        s=torch.where(present, front - LENGTH / 2, vehicles.s),
        speed=torch.where(present, speed, vehicles.speed),
    )


class SumoIntersection(ReplayedIntersection, TensorIntersection):
    """``num_envs`` intersections with SUMO's drivers, each simulation in a process of its own.

    Same specs, keys, units and seeds as :class:`BatchedIntersection`; an episode of a seed begins with the same scene.
    The ego moves by its own dynamics and is put into SUMO in each substep, which lasts a whole number of milliseconds
    there (67 ms for 1/15 s, 33 ms for 1/30 s). Collisions are found by our separating axes.

    Args:
        task: its settings.
        num_envs: B.
        seed: of the sequences of episodes; None: others each time.
        device: of the tensors; the simulation itself runs on the CPU.
        drivers: a name in :data:`~saferl.envs.intersection.sumo_net.MANNERS`.

    Raises:
        ValueError: there are no such drivers; libsumo or eclipse-sumo is missing.

    >>> env = SumoIntersection(Scenario(task="gs"), num_envs=2)
    >>> env.rollout(2)["next", "vehicles"].shape
    torch.Size([2, 2, 11, 12])
    >>> env.close()
    """

    def __init__(
        self,
        task: Scenario,
        num_envs: int = 1,
        seed: int | None = None,
        device=None,
        drivers: str = "perfect",
    ):
        if drivers not in MANNERS:
            raise ValueError(f"drivers must be one of {', '.join(MANNERS)}, got {drivers!r}.")
        if not installed():
            raise ValueError("env=sumo needs libsumo and eclipse-sumo: pip install 'saferl[sumo]'.")
        super().__init__(task, num_envs, seed, device)
        self.made_with = MappingProxyType({"drivers": drivers})
        step = round(1000 * task.dt)
        self._options = [
            "--net-file", str(network()), "--route-files", str(traffic(drivers)),
            "--step-length", f"{step / 1000}", "--insertion-checks", "none",
            "--time-to-teleport", "-1", "--collision.action", "none",
            "--no-step-log", "--no-warnings", "--xml-validation", "never",
        ]  # fmt: skip
        self._state: State = {}
        self._make_memory()
        self._process, self._connections = _start_workers(num_envs)
        self._end = weakref.finalize(self, _end, self._process, self._connections)

    def _ask(self, name: str, each: dict[int, tuple]) -> list[Any]:
        """What the simulations of some environments answer, which work side by side."""
        for index, arguments in each.items():
            self._connections[index].send((name, arguments))
        try:
            answers = [self._connections[index].recv() for index in each]
        except EOFError:
            raise RuntimeError(f"a process of SUMO has died in {name}.") from None
        for done, answer in answers:
            if not done:
                raise RuntimeError(f"SUMO failed in {name}: {answer}")
        return [answer for _, answer in answers]

    def _keep(self, rows: Tensor, state: State, shown: State) -> dict[int, dict[str, Any]]:
        if not self._state:
            count = self.batch_size[0]
            self._state = {k: v.new_zeros((count, *v.shape[1:])) for k, v in state.items()}
        for key, value in state.items():
            self._state[key] = self._state[key].index_copy(0, rows, value)
        shown = {key: value[rows] for key, value in self._observation().items()} | shown
        return {
            index: {key: value[place] for key, value in shown.items()}
            for place, index in enumerate(rows.tolist())
        }

    def _start_all(self, seeds: dict[int, int]) -> dict[int, dict[str, Any]]:
        rows = torch.tensor(list(seeds))
        state = begin(self.task, torch.tensor(list(seeds.values())))
        vehicles, where = vehicles_of(state), poses(state["ego"])
        self._ask(
            "begin",
            {
                index: (
                    [*self._options, "--seed", str(seed)],
                    _entering(mine := _of(vehicles, place), mine.present),
                    int(state["route"][place]),
                    where[place],
                )
                for place, (index, seed) in enumerate(seeds.items())
            },
        )
        no = torch.zeros(len(rows), dtype=torch.bool)
        return self._keep(rows, state, dict.fromkeys(OUTCOMES, no))

    def _advance_all(self, actions: dict[int, np.ndarray]) -> dict[int, dict[str, Any]]:
        if not actions:
            return {}
        rows = torch.tensor(list(actions))
        state = {key: value[rows] for key, value in self._state.items()}
        action = torch.from_numpy(np.stack(list(actions.values()))).to(state["ego"])
        ego, where = state["ego"], []
        for _ in range(SUBSTEPS):
            ego = step_ego(ego, to_physical(action), self.task.dt)
            where.append(poses(ego))
        each = {i: ([pose[place] for pose in where],) for place, i in enumerate(actions)}
        seen = list(zip(*self._ask("move", each), strict=True))  # [substep][environment]

        def moved(vehicles: Vehicles, ego: Tensor, substep: int) -> Vehicles:
            return placed(vehicles, list(seen[substep]))

        before = vehicles_of(state)
        state, shown = advance(self.task, state, action, moved)
        if self.task.traffic.respawn:
            self._let_in(actions, vehicles_of(state), placed(before, list(seen[-1])).present)
        return self._keep(rows, state, shown)

    def _let_in(self, rows: Iterable[int], vehicles: Vehicles, there: Tensor) -> None:
        """Tell SUMO who of the vehicles [N, K] enters the road: who is not yet ``there`` [N, K]."""
        joins = vehicles.present & ~there
        entering = {
            index: (_entering(_of(vehicles, place), joins[:, place]),)
            for place, index in enumerate(rows)
            if joins[:, place].any()
        }
        self._ask("enter", entering)

    def close(self, **kwargs) -> None:
        """End the simulations' processes."""
        self._end()
        super().close(**kwargs)


def _of(vehicles: Vehicles, place: int) -> Vehicles:
    """Those [N] of one environment."""
    return Vehicles(*(field[:, place] for field in vehicles))


def _start_workers(count: int) -> tuple[subprocess.Popen, list[Connection]]:
    """The process of so many simulations' processes, and connections to them."""
    ours, theirs = zip(*(Pipe() for _ in range(count)), strict=True)
    descriptors = [connection.fileno() for connection in theirs]
    # -P: what lies beside the worker is none of its imports.
    command = [sys.executable, "-P", str(_WORKER), *map(str, descriptors)]
    process = subprocess.Popen(command, pass_fds=descriptors)
    for connection in theirs:
        connection.close()
    return process, list(ours)


def _end(process: subprocess.Popen, connections: list[Connection]) -> None:
    for connection in connections:
        connection.close()
    process.wait()
