"""A trained policy as one module, with its projector inside."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.algorithms.assemble import load_agent
from saferl.algorithms.base import Agent, chain
from saferl.checkpoint.run import progress, run_config
from saferl.config.locate import pretrained_run, shipped
from saferl.envs.transforms import Correction, SafetyProjector
from saferl.modules import ProjectionResult
from saferl.training.progress import Budget

#: What a policy with a projector writes besides the action.
REPORTED = {
    "action_proposed": "the policy's own",
    "risk_before": "of the proposed action, Q_c(s, a)",
    "risk_after": "of the action",
    "projection_steps": "that the correction took",
    "intervened": "whether the two actions differ",
    "feasible": "whether the risk of the action is within the limit",
}


class SafePolicy(TensorDictModuleBase):
    """The mean action of a policy, corrected wherever its risk exceeds a limit: what ships.

    In an environment :class:`~saferl.envs.transforms.SafetyProjector` does the same as a transform; this needs none.

    Args:
        actor: reads the observation and writes ``action`` [*B, A].
        projector: of its actions; None: they are executed as they are.
        low, high: of the actions.

    Reads what ``actor`` and the projector read. Writes ``action`` [*B, A], what is to be executed; with a projector
    also ``action_proposed`` [*B, A], ``risk_before``, ``risk_after`` [*B, 1], ``intervened`` [*B, 1] (bool) and what else
    :class:`~saferl.envs.transforms.SafetyProjector` tells. Of a locked TensorDict it returns a copy with these entries.

    Raises:
        ValueError: in a step, an action is not finite.

    >>> import torch
    >>> from tensordict import TensorDict
    >>> from tensordict.nn import TensorDictModule
    >>> from saferl.envs.transforms import SafetyProjector
    >>> actor = TensorDictModule(lambda x: x, ["x"], ["action"])
    >>> risk = TensorDictModule(lambda x, action: action, ["x", "action"], ["risk"])
    >>> policy = SafePolicy(actor, SafetyProjector(risk, limit=0.5))
    >>> out = policy(TensorDict({"x": torch.tensor([[0.2], [0.9]])}, [2]))
    >>> bool((out["action"] <= 0.5).all()), out["intervened"].flatten().tolist()
    (True, [False, True])
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        projector: Correction | None = None,
        low: float = -1.0,
        high: float = 1.0,
    ):
        super().__init__()
        reads, reports = (), ()
        if projector is not None:
            reads, reports = projector.reads, ("action_proposed", *projector.reports)
        keys = dict.fromkeys((*actor.in_keys, *reads))
        self.in_keys: list = [key for key in keys if key != "action"]
        self.out_keys: list = ["action", *reports]
        self.actor, self.projector, self.box = actor, projector, {"low": low, "high": high}

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not tensordict.batch_size.numel():  # distributions and critics want one state
            one = self.forward(tensordict.select(*self.in_keys).new_zeros(torch.Size([1])))
            none = one[:0].reshape(tensordict.batch_size)
            return (tensordict.copy() if tensordict.is_locked else tensordict).update(none)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            seen = self.actor(tensordict.select(*self.in_keys))
        action = seen["action"]
        tensordict = tensordict.copy() if tensordict.is_locked else tensordict
        if not action.isfinite().all():
            raise ValueError(
                "the policy gave an action that is not finite; look at what it observes."
            )
        if self.projector is None:
            return tensordict.set("action", action)
        report = self.projector.correct(seen, **self.box)
        tensordict.update(report.exclude("action_executed"))
        tensordict.set("action_proposed", action)
        return tensordict.set("action", report["action_executed"])

    @torch.no_grad()
    def project(self, state: Mapping[str, Tensor], action: Tensor) -> ProjectionResult:
        """Another's action, corrected as the policy's own is: for a planner, or a loop of your own.

        For a risk of your own see :func:`saferl.modules.project`.

        Args:
            state: what the policy observes, by its keys, [*B, ...].
            action: [*B, A], in the policy's units.

        Returns:
            The action to execute, its risk and what else is to be known, tensors [*B] and [*B, A].

        Raises:
            ValueError: the policy has no projector along the gradient of a risk; an entry is missing or of another size than
                it was trained with; an action or a risk is not finite.

        >>> import saferl
        >>> policy = saferl.load_policy("arsac")
        >>> alone = {"ego": torch.zeros(5, 12), "vehicles": torch.zeros(5, 11, 12)}
        >>> result = policy.project(alone, torch.zeros(5, 2))
        >>> result.action.shape, result.feasible.shape
        (torch.Size([5, 2]), torch.Size([5]))
        """
        if not isinstance(self.projector, SafetyProjector):
            got = "none" if self.projector is None else type(self.projector).__name__
            raise ValueError(f"project needs a policy with a SafetyProjector, got {got}.")
        given = {**state, "action": action}
        names = [str(key) for key in self.projector.reads]
        if missing := [name for name in names if name not in given]:
            raise ValueError(f"project needs {', '.join(names)}, got no {missing[0]}.")
        shapes = ", ".join(f"{name} {[*given[name].shape]}" for name in names)
        try:
            seen = TensorDict(given, action.shape[:-1])
            told = self.projector.correct(seen, **self.box)
        except RuntimeError as error:  # of the batch or of a layer, which name no entry
            if torch.is_inference_mode_enabled():  # the projector's own, which says all
                raise
            reason = str(error).splitlines()[0]
            raise ValueError(
                f"project needs sizes that the policy was trained with, got {shapes}: {reason}"
            ) from error
        if not (action.isfinite().all() and told["risk_before"].isfinite().all()):
            raise ValueError(
                "project needs numbers: the action, or the risk of the state, is not finite."
            )
        rest = (told[name].squeeze(-1) for name in tuple(REPORTED)[1:])
        before, after, steps, intervened, feasible = rest
        return ProjectionResult(
            told["action_executed"], before, after, steps.to(torch.int64), intervened, feasible
        )


def compiling(cfg: DictConfig, on: bool) -> DictConfig:
    """A run's configuration with the physics and the projection compiled or not, as far as it has them."""
    cfg = cfg.copy()
    parts = [(cfg.env, "compile_physics"), *((node, "compile") for node in chain(cfg.projector))]
    for part, key in parts:
        if key in part:
            part[key] = on
    return cfg


def trained_agent(cfg: DictConfig, path: Path) -> Agent:
    """The agent of a run or checkpoint, its projector as far as the training had come.

    Args:
        cfg: the run's configuration.
        path: the run or checkpoint.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: it does not fit the configuration.
    """
    agent = load_agent(cfg, path, "checkpoint")
    if agent.transform is not None:
        agent.transform.enabled = False  # a test reports what was earned
    if agent.projector is not None:
        spent = Budget(cfg.episodes, cfg.frames).spent(**progress(path))
        agent.projector.set_progress(spent)
    return agent


def load_policy(
    source: str | Path, device: str | torch.device = "cpu", project: bool = True
) -> SafePolicy:
    """A policy that ships with saferl, or one of your own, ready to drive.

    Args:
        source: the name of a policy that ships with saferl (``arsac``; ``./arsac`` is a path), or the path of a run, a checkpoint, or an exported
            ``policy.safetensors``.
        device: of the networks.
        project: whether the projector corrects its actions, if it was trained with one.

    Raises:
        ValueError: there is no policy of this name or at this path, or its file is damaged.
        FileNotFoundError: the run has no checkpoint.
    """
    path = Path(source)
    if str(source) in shipped():
        path = pretrained_run(str(source))
    elif not path.exists():
        names = ", ".join(shipped())
        raise ValueError(f"load_policy takes a path, or one of {names}, got {str(source)!r}.")
    # Compiling takes minutes, and is worth it for millions of decisions.
    cfg = compiling(run_config(path), False)
    cfg.device = str(torch.device(device))
    agent = trained_agent(cfg, path)
    return SafePolicy(agent.actor, agent.projector if project else None).eval()  # pyright: ignore
