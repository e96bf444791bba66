"""The time that a projection takes, every state risky and every step used.

    python benchmarks/projector.py [--batches 1 32 256] [--width 256] [--steps 50] [--rounds 5]
        [--seconds 2] [--clock wall] [--threads 1] [--device cpu] [--json PATH]

Each side corrects the same actions in the same random scenes, from the observation to the executed
action, with a limit that no action meets:

- plain: MMAM critics as printed, evaluated whole and differentiated by autograd for each step, without
  the rule that lets a coordinate slide along the edge of the box;
- eager: what no action changes is computed once;
- compiled: the same by way of ``SafetyProjector(compile=True)``.

Prints milliseconds for each batch and what ours gains over plain. A car decides every 100 ms.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from plain import PlainMMAMValue
from side_by_side import alternate, conditions, medians, parser, write
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Transform, TransformedEnv

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.transforms import SafetyProjector
from saferl.modules import CriticEnsemble, MMAMValue, value_operator


def scenes(batch: int, device: str) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    vehicles = torch.randn(batch, 11, 6, generator=generator) * 10
    count = torch.randint(1, 11, (batch, 1), generator=generator)
    vehicles[..., 0] = (torch.arange(11) < count).float()
    action = torch.rand(batch, 2, generator=generator) - 0.5
    entries = {"ego": torch.randn(batch, 9, generator=generator), "vehicles": vehicles}
    return TensorDict({**entries, "action": action}, [batch]).to(device)


def plain(critics: CriticEnsemble, data: TensorDict, steps: int, penalty: float = 1.0) -> Tensor:
    """E8 to E10 as one would write them first."""
    start = data["action"]
    action = start.clone()
    for _ in range(steps):
        action = action.detach().requires_grad_()
        risk = critics(data.copy().set("action", action))["risk"]
        loss = 0.5 * (action - start).square().sum() + penalty * risk.relu().sum()
        (gradient,) = torch.autograd.grad(loss, action)
        norm = gradient.abs().amax(-1, keepdim=True).clamp(min=1e-12)
        action = (action - 0.02 * gradient / norm).clamp(-1, 1)
    return action.detach()


def main() -> None:
    args = parser(__doc__, seconds=2.0)
    args.add_argument("--batches", type=int, nargs="+", default=[1, 32, 256])
    args.add_argument("--width", type=int, default=256)
    args.add_argument("--steps", type=int, default=50)
    options = args.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)

    def ensemble(kind: type[torch.nn.Module]) -> CriticEnsemble:
        networks = [kind(width=options.width) for _ in range(2)]
        return CriticEnsemble([value_operator(n, out_key="risk") for n in networks]).to(
            options.device
        )

    ours, printed = ensemble(MMAMValue), ensemble(PlainMMAMValue)
    printed.load_state_dict(ours.state_dict())
    # Everything is risky, and no action is good enough to end early. The box is the environment's.
    road = BatchedIntersection(Scenario(observation="world"), device=options.device, seed=0)
    forms = {
        name: TransformedEnv(
            road, SafetyProjector(ours, -1e9, steps=options.steps, compile=name == "compiled")
        )
        for name in ("eager", "compiled")
    }
    sides: dict[str, Callable[[], int]] = {}
    for batch in options.batches:
        data = scenes(batch, options.device)

        def whole(data: TensorDict = data) -> int:
            plain(printed, data, options.steps)
            return 1

        sides[f"plain {batch}"] = whole
        for name, env in forms.items():

            def correct(data: TensorDict = data, correction: Transform = env.transform) -> int:
                correction.inv(data.copy())
                return 1

            correct()
            sides[f"{name} {batch}"] = correct
        with torch.no_grad():
            projected = forms["compiled"].transform.inv(data.copy())
        taken = projected["_correction", "projection_steps"]
        if not bool((taken == options.steps).all()):
            raise SystemExit(f"Expected {options.steps} steps of each state, got {taken}.")
        difference = (projected["action"] - plain(printed, data, options.steps)).abs().amax(-1)
        print(
            f"batch {batch}: {(difference < 1e-4).float().mean():.0%} of the actions equal plain's"
        )

    rates = alternate(sides, options)
    speed = medians(rates)
    print(f"{conditions(options)}, width {options.width}, {options.steps} steps")
    print(f"{'batch':>8s}{'plain ms':>12s}{'eager ms':>12s}{'compiled ms':>13s}{'gain':>8s}")
    figures: dict = {"rounds": rates, "conditions": conditions(options)}
    for batch in options.batches:
        ms = {form: 1e3 / speed[f"{form} {batch}"] for form in ("plain", "eager", "compiled")}
        gain = ms["plain"] / ms["compiled"]
        print(f"{batch:8d}{ms['plain']:12.1f}{ms['eager']:12.1f}{ms['compiled']:13.1f}{gain:8.1f}")
        figures[f"latency_ms_batch{batch}"] = ms["compiled"]
        figures[f"ratio_over_plain_{batch}"] = gain
    write(options.json, figures)


if __name__ == "__main__":
    main()
