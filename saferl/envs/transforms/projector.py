"""Correction of risky actions on the way to the environment, and of the actions in the buffer."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs.transforms import Transform

from saferl.envs.transforms.correction import Correction, Switched
from saferl.modules.compiled import Compiled
from saferl.modules.limits import as_limit
from saferl.modules.projection import project

_ROWS = 32  # corrected together in compiled code


class SafetyProjector(Switched, Correction):
    """Executes a corrected action wherever the risk of the proposed one exceeds a limit; of several risks, where any does.

    The correction is :func:`saferl.modules.project` (paper, E8 to E10) on the risk
    Q_c(s, a) that ``risk`` predicts, within the box of the environment's action spec. Append it
    outermost, outside a ``SerialEnv`` or ``ParallelEnv``: it then meets the policy's own action, random
    warm-up actions included, with all environments in one batch. ``action`` in collected data stays the
    proposed one, whose log-probability the policy knows; :class:`ExecutedAction` swaps it in an
    off-policy buffer.

    Args:
        risk: a TensorDictModule that reads observation entries and the action and writes the risk
            [*B, K], of each of K costs, under its first ``out_key``. If it has a ``bind(tensordict)`` method that returns
            :class:`saferl.modules.BoundCritics` (as :class:`saferl.modules.CriticEnsemble` does), what
            does not depend on the action is computed once for all steps.
        limit: d_thres, the largest risk that is left alone; of several costs a list [K], and the one that exceeds its own
            most is lowered.
        steps: N_iter, the largest number of correction steps.
        step_size: eta, the largest move of a coordinate in a step, in the units of the action.
        penalty: lambda_a, see :func:`saferl.modules.project`.
        keep: ``"last"`` or ``"safest"``, what is executed where no step reached the limit.
        start: fraction of a run after which the correction acts, see :meth:`set_progress`; with 0
            it acts from the first step on, as printed in Algorithm 1.
        compile: whether it is compiled, the correction in parts of at most 32 states.
        action_key: the entry of the proposed action.

    Attributes:
        latencies: seconds that each of the last 10,000 corrections took, of all risky states of a step
            together (on a GPU: to queue them).
        enabled: whether it corrects yet.

    Reads the action and the observation at the time of a step. Writes under ``next``:
    ``action_executed`` [*B, A]; ``risk_before`` and ``risk_after`` [*B, K], the risks of the
    proposed and the executed action; ``projection_steps`` [*B, 1] (float32); ``intervened``
    [*B, 1] (bool), whether the two actions differ; ``feasible`` [*B, 1] (bool), whether the
    executed one is within every limit. All are zero after a reset. While disabled, actions pass
    unchanged and the risks are still reported.

    Raises:
        ValueError: if ``start`` is not in [0, 1], ``risk`` does not read the action, or for a setting that
            ``project`` refuses.
        RuntimeError: in a step under ``torch.inference_mode``; ``torch.no_grad`` is fine.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
        >>> from saferl.envs.transforms import SafetyProjector
        >>> risk = TensorDictModule(  # "the first action coordinate is the risk"
        ...     lambda observation, action: action[..., :1], ["observation", "action"], ["risk"]
        ... )
        >>> env = TransformedEnv(ContinuousActionVecMockEnv(), SafetyProjector(risk, limit=0.5))
        >>> data = env.rollout(3)
        >>> bool((data["next", "action_executed"][..., 0] <= 0.5).all())
        True
    """

    _limit: Tensor

    def __init__(
        self,
        risk: TensorDictModuleBase,
        limit: float | Sequence[float],
        *,
        steps: int = 50,
        step_size: float = 0.02,
        penalty: float = 1.0,
        keep: str = "last",
        start: float = 0.0,
        compile: bool = False,
        action_key: NestedKey = "action",
    ):
        super().__init__(action_key)
        if not 0.0 <= start <= 1.0:
            raise ValueError(f"start must be a fraction in [0, 1], got {start}.")
        if self.action_key not in getattr(risk, "in_keys", ()):
            raise ValueError(
                f"risk must be a TensorDictModule that reads {self.action_key!r}, got {risk}."
            )
        self.risk = risk
        self.register_buffer("_limit", as_limit("limit", limit), persistent=False)
        risks = self._limit.numel()
        self.reports = {
            "risk_before": (torch.float32, risks),
            "risk_after": (torch.float32, risks),
            "projection_steps": (torch.float32, 1),
            **Correction.reports,
            "feasible": (torch.bool, 1),
        }
        self.settings: dict[str, Any] = {
            "steps": steps,
            "step_size": step_size,
            "penalty": penalty,
            "keep": keep,
        }
        # Refuses bad settings now and not in the middle of a run.
        project(
            lambda action: action.expand(0, risks), torch.zeros(0, 1), self._limit, **self.settings
        )
        if compile and not hasattr(risk, "bind"):
            raise ValueError(
                f"compile=True needs a risk with bind(), as CriticEnsemble; set compile=False for {risk}."
            )
        self.settings["compile"] = compile
        self._see = self._look
        if compile:
            self._see = Compiled(self._look, "the projector's look at a state", replay=False)
        self.start = float(start)
        self.enabled = start == 0.0

    @property
    def reads(self) -> Sequence[NestedKey]:
        return self.risk.in_keys

    @property
    def limit(self) -> float | list[float]:
        """As given: a number, or one for each cost."""
        return self._limit.tolist()

    def get_extra_state(self) -> bool:
        return self.enabled

    def set_extra_state(self, state: bool) -> None:
        self.enabled = state

    def set_progress(self, fraction: float) -> None:
        """Switches the correction on once ``fraction`` of the run is at least ``start``."""
        self.enabled = fraction >= self.start

    def _look(self, inputs: TensorDictBase) -> tuple[Callable[[Tensor], Tensor], Tensor]:
        """The risk [N, K] as a function of the action alone [N, A], and that of the action given."""
        bind, action = getattr(self.risk, "bind", None), inputs.get(self.action_key)
        if bind is None:

            def of_action(action: Tensor) -> Tensor:
                seen = inputs.copy().set(self.action_key, action)
                return self.risk(seen).get(self.risk.out_keys[0])

        else:
            of_action = bind(inputs).detach()
        return of_action, of_action(action).reshape(len(action), self._limit.numel())

    def _in_parts(self, risky: Tensor) -> Sequence[Tensor | slice]:
        """The rows to correct, a slice where these are all. A GPU corrects all at once, where the
        others stay as they are, rather than wait to know which; compiled code gets always as many,
        the last ones more than once."""
        if risky.device.type != "cpu":
            return [slice(None)]
        size = min(len(risky), _ROWS) if self.settings["compile"] else len(risky)
        rows = risky.nonzero().squeeze(-1)
        if not len(rows):
            return []
        if len(rows) == size == len(risky):
            return [slice(None)]
        if not self.settings["compile"]:
            return [rows]
        missing = -len(rows) % size
        return torch.cat([rows, rows[-1:].expand(missing)]).split(size)

    @torch.no_grad()
    def correct(self, tensordict: TensorDictBase, **box: Any) -> TensorDict:
        """What is to be executed in place of the proposed action, without an environment.

        Args:
            tensordict: [*B], with what the risk reads; stays as it is.
            **box: ``low`` and ``high`` of the actions, see :func:`saferl.modules.project`.

        Returns:
            The entries that a step writes under ``next``, [*B].
        """
        if torch.is_inference_mode_enabled():  # also where no state happens to be risky
            raise RuntimeError(
                "the projector needs gradients: use torch.no_grad, not inference_mode."
            )
        inputs = tensordict.select(*self.risk.in_keys).reshape(-1)
        action = inputs.get(self.action_key)

        risk, before = self._see(inputs)
        limit = self._limit.to(before)
        executed, after, steps = action.clone(), before.clone(), torch.zeros_like(before[:, 0])
        parts = self._in_parts((before > limit).any(-1)) if self.enabled else []
        if len(parts):
            begin = time.perf_counter()
            for rows in parts:
                # Only the risky samples are worth up to `steps` evaluations.
                if isinstance(rows, Tensor):
                    risk, _ = self._see(inputs[rows])
                result = project(risk, action[rows], limit, **self.settings, **box)
                executed[rows] = result.action
                after[rows] = result.risk_after.reshape(-1, limit.numel())
                steps[rows] = result.steps.to(steps)
            self.latencies.append(time.perf_counter() - begin)

        return TensorDict(
            {
                "action_executed": executed,
                "risk_before": before.float(),
                "risk_after": after.float(),
                "projection_steps": steps.float().unsqueeze(-1),
                "intervened": (executed != action).any(-1, keepdim=True),
                "feasible": (after <= limit).all(-1, keepdim=True),
            },
            inputs.batch_size,
        ).reshape(tensordict.batch_size)


class ExecutedAction(Transform):
    """Makes a replay buffer store the action that the environment executed.

    Off-policy critics must learn from what happened (Algorithm 1, paper: the corrected action is
    stored). Append it to the buffer, not to the environment; it acts when data is added and leaves
    samples as they are. On-policy losses must keep the proposed action and need no such transform.

    Args:
        executed_key: where the executed action is, as :class:`SafetyProjector` writes it.
        action_key: the entry that gets it.
        proposed_key: the entry that keeps the policy's action.

    Reads ``("next", "action_executed")`` and ``action`` [*B, A]. Writes ``action``, the executed
    one, and ``action_proposed``, unless the latter is there already: data that went through once
    can go through again. The collected data itself is not changed.

    Raises:
        KeyError: if the data has no executed action.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from saferl.envs.transforms import ExecutedAction
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), transform=ExecutedAction())
        >>> data = TensorDict(
        ...     {"action": torch.ones(3, 2), "next": {"action_executed": torch.zeros(3, 2)}}, [3]
        ... )
        >>> _ = buffer.extend(data)
        >>> buffer[0]["action"], buffer[0]["action_proposed"], data[0]["action"]
        (tensor([0., 0.]), tensor([1., 1.]), tensor([1., 1.]))
    """

    def __init__(
        self,
        executed_key: NestedKey = ("next", "action_executed"),
        action_key: NestedKey = "action",
        proposed_key: NestedKey = "action_proposed",
    ):
        super().__init__()
        self.executed_key = unravel_key(executed_key)
        self.action_key = unravel_key(action_key)
        self.proposed_key = unravel_key(proposed_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        executed = tensordict.get(self.executed_key, None)
        if executed is None:
            raise KeyError(
                f"No executed action under {self.executed_key!r}, got the entries "
                f"{sorted(map(str, tensordict.keys(True, True)))}. "
                f"Append a SafetyProjector to the environment, or drop ExecutedAction."
            )
        stored = tensordict.clone(recurse=False)
        if stored.get(self.proposed_key, None) is None:
            stored.set(self.proposed_key, stored.get(self.action_key))
        # A copy, or a sample edited in place would change both entries of a shared tensor.
        return stored.set(self.action_key, executed.clone())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict
