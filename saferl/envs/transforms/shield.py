"""The shield: an action is executed only if some fallback could still save the car after it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TransformedEnv

from saferl.envs.intersection import Scenario
from saferl.envs.intersection.batched import State
from saferl.envs.intersection.drivers import Brake, CautiousDriver, Driver, Hold
from saferl.envs.intersection.foresight import (
    AlongLanes,
    Prediction,
    over,
    pick,
    safe_for,
    watched,
)
from saferl.envs.transforms.correction import Correction


class Shield(Correction):
    """Lets an action pass if some fallback stays safe after it, and else lets the safest fallback drive.

    From the present scene it plays forward what follows from the proposed action, held for one decision, and then from each
    fallback; the others move by ``prediction``. A fallback is safe if until ``horizon`` the ego hits nobody, comes to nobody
    nearer than ``margin``, does not leave the road, or before that arrives or stands where nobody will hit it. If none is safe
    after the action, the fallbacks are played forward from now on: the one for which nothing happens for longest drives, of
    equal ones the first. An action that passes stays the same, bit for bit. This is the scheme of a simplex architecture
    (Sha, *Using simplicity to control complexity*, 2001) with a look ahead as its decision.

    It learns nothing and has no state. What it promises is as good as the prediction: by
    :class:`~saferl.envs.intersection.foresight.AlongLanes` it knows the road and no more than the policy; by
    :class:`~saferl.envs.intersection.foresight.Simulator` it knows what no car knows.

    Args:
        prediction: of the others; None: they go on along their lanes.
        fallbacks: drivers by name, in the order in which they are preferred: TensorDictModules that read ``ego``,
            ``vehicles`` and ``route`` (of the form ``world``) and write ``action``. None: :class:`Brake`, :class:`Hold`,
            :class:`CautiousDriver` and the blind :class:`Driver`, which goes.
        horizon: s, how far it looks.
        margin: m, of the others: who comes nearer, and nearer than now, counts as hit.
        frequency: decisions a second; None: the environment's own, or a test's where there is none.
        name: what its tests are called: ``sac + shield``.
        first: what corrects the action before, such as a :class:`SafetyProjector`; the shield has the last word.

    Attributes:
        latencies: seconds of the last 10,000 looks, of all environments together, without those of ``first``.

    Reads ``ego``, ``vehicles``, ``route`` and the action at the time of a step, on an intersection. Writes under ``next``
    what ``first`` does, and: ``action_executed`` [*B, 2]; ``intervened`` [*B, 1] (bool), whether it or ``first`` changed the
    action; ``feasible`` [*B, 1] (bool), whether what drives is safe; ``fallback`` [*B, 1] (int64), 0 where the action passes,
    else the number of the fallback that drives, from 1.

    Raises:
        ValueError: no fallback, or one that is no TensorDictModule, ``horizon`` or ``frequency`` not above 0, ``margin`` below 0; in a step, an action that is not finite, an environment that is no intersection, or
            not the batched one for the simulator's prediction.

    Examples:
        >>> import torch
        >>> from torchrl.envs import TransformedEnv
        >>> from saferl.envs.intersection import BatchedIntersection, Scenario
        >>> from saferl.envs.intersection.drivers import Driver
        >>> from saferl.envs.transforms import Shield
        >>> road = BatchedIntersection(Scenario(task="gs").as_test(), num_envs=4, seed=2)
        >>> data = TransformedEnv(road, Shield()).rollout(60, Driver())  # blind to traffic
        >>> bool(data["next", "intervened"].any()), bool(data["next", "collision"].any())
        (True, False)
    """

    def __init__(
        self,
        prediction: Prediction | None = None,
        fallbacks: Mapping[str, TensorDictModuleBase] | None = None,
        horizon: float = 5.0,
        margin: float = 0.5,
        frequency: float | None = None,
        name: str = "shield",
        first: Correction | None = None,
    ):
        super().__init__()
        if fallbacks is None:
            fallbacks = {
                "brake": Brake(),
                "hold": Hold(),
                "cautious": CautiousDriver(),
                "go": Driver(),
            }
        if not fallbacks or not isinstance(fallbacks, Mapping):
            raise ValueError(f"fallbacks must be drivers by name, one at least, got {fallbacks!r}.")
        for key, driver in fallbacks.items():
            if not isinstance(driver, TensorDictModuleBase):
                raise ValueError(
                    f"fallbacks.{key} must be a TensorDictModule that writes action, got {driver!r}."
                )
        for key, value in (("horizon", horizon), ("frequency", frequency)):
            if value is not None and value <= 0:
                raise ValueError(f"{key} must be > 0, got {value}.")
        if margin < 0:
            raise ValueError(f"margin must be >= 0, got {margin}.")
        self.prediction = AlongLanes() if prediction is None else prediction
        self.names, self.fallbacks = [*fallbacks], torch.nn.ModuleList(fallbacks.values())
        self.horizon, self.margin, self.frequency = float(horizon), float(margin), frequency
        self.name, self.first = name, first
        own = {"feasible": (torch.bool, 1), "fallback": (torch.int64, 1)}
        self.reports = {**(first or Correction).reports, **own}

    @property
    def reads(self) -> Sequence[NestedKey]:
        own = ("ego", "vehicles", "route", self.action_key)
        return (*dict.fromkeys((*(self.first.reads if self.first else ()), *own)),)

    @property
    def limit(self) -> float | list[float] | None:
        """The risk that ``first`` leaves alone, if it has one."""
        return getattr(self.first, "limit", None)

    def set_progress(self, fraction: float) -> None:
        if self.first is not None:
            self.first.set_progress(fraction)

    def _road(self) -> tuple[Any, Scenario]:
        """The environment itself, None without one, and how it is played."""
        env: Any = self.container
        while isinstance(env, TransformedEnv):
            env = env.base_env
        scenario = Scenario().as_test() if env is None else getattr(env, "task", None)
        if isinstance(scenario, Scenario) and self.frequency is None:
            return env, scenario
        if self.frequency is None:
            raise ValueError(
                f"Shield needs frequency=, the decisions a second, around {type(env).__name__}: it is no intersection itself."
            )
        scenario = scenario if isinstance(scenario, Scenario) else Scenario()
        return env, dataclasses.replace(scenario, policy_frequency=self.frequency)

    @torch.no_grad()
    def correct(self, tensordict: TensorDictBase, **box: Any) -> TensorDict:
        """What is to be executed in place of the proposed action.

        Args:
            tensordict: [*B], with :attr:`reads`; stays as it is.
            **box: ``low`` and ``high`` of the actions, for ``first``; fallbacks stay in [-1, 1].

        Returns:
            The entries that a step writes under ``next``, [*B].
        """
        env, scenario = self._road()
        seen = tensordict.select(*self.reads).reshape(-1)
        proposed = seen.get(self.action_key)
        if not proposed.isfinite().all():  # every comparison would call it safe
            raise ValueError("the policy gave an action that is not finite.")
        report = TensorDict({}, seen.batch_size)
        if self.first is not None:
            report = self.first.correct(seen, **box)
        action = report.get("action_executed", proposed)
        begin = time.perf_counter()
        which, executed, safe = self._decide(
            self.prediction.begin(seen, env, scenario), scenario, action
        )
        self.latencies.append(time.perf_counter() - begin)
        report["action_executed"] = executed
        report["intervened"] = (executed != proposed).any(-1, keepdim=True)
        report["feasible"], report["fallback"] = safe[:, None], which[:, None]
        return report.reshape(tensordict.batch_size)

    def _decide(
        self, scene: State, scenario: Scenario, action: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Who drives [R], with which action [R, 2], and whether that is safe [R]."""

        def unsafe(those: Tensor, number: int, first: Tensor | None = None) -> Tensor:
            """Until when a fallback is safe in some of the scenes."""
            driver: Any = self.fallbacks[number]
            part = pick(scene, those)
            try:
                return safe_for(
                    self.prediction, scenario, part, driver, self.horizon, first, self.margin
                )
            except ValueError as error:
                raise ValueError(f"Shield: the fallback {self.names[number]}: {error}") from error

        which = torch.zeros(len(action), dtype=torch.int64, device=action.device)
        executed, safe = action.clone(), which == 0
        # Each fallback is asked about those alone that none before it has saved. What is over is left alone.
        left = (~over(self.prediction, scene)).nonzero().squeeze(-1)
        for number in range(len(self.fallbacks)):
            if len(left):
                left = left[unsafe(left, number, action[left]).isfinite()]
        if not len(left):
            return which, executed, safe
        longest = torch.full_like(scene["ego"][:, 0], -1.0)
        for number in range(len(self.fallbacks)):
            asked = left[longest[left].isfinite()]
            if len(asked):
                time = unsafe(asked, number)
                better = asked[time > longest[asked]]
                longest[asked] = torch.maximum(longest[asked], time)
                which[better] = number + 1
        for number, driver in enumerate(self.fallbacks, 1):
            those = (which == number).nonzero().squeeze(-1)
            if len(those):
                ahead = watched(self.prediction, pick(scene, those))
                executed[those] = driver(ahead)["action"].to(executed)
        safe[left] = longest[left].isinf()
        return which, executed, safe
