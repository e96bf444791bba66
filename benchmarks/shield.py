"""What a decision behind the shield takes, beside one without.

    python benchmarks/shield.py [--policy asac] [--batches 1 64] [--decisions 45] [--rounds 5] [--seconds 3] [--clock wall]
        [--threads 1] [--json PATH]

A policy that ships drives a batch of test scenes for some decisions. From there each side makes the same decision again and
again: the policy, what corrects it, and the simulator's step. Prints milliseconds of all scenes together, and the ratio
to the side without a shield. A car decides every 100 ms.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from side_by_side import alternate, conditions, medians, parser, write
from torchrl.envs import EnvBase, TransformedEnv

import saferl
from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.foresight import AlongLanes, ConstantVelocity, Simulator
from saferl.envs.transforms import Shield

PREDICTIONS = {
    "constant velocity": ConstantVelocity,
    "along lanes": AlongLanes,
    "simulator": Simulator,
}


def main() -> None:
    args = parser(__doc__)
    args.add_argument("--policy", default="asac")
    args.add_argument("--batches", type=int, nargs="+", default=[1, 64])
    args.add_argument("--decisions", type=int, default=45)
    options = args.parse_args()
    torch.set_num_threads(options.threads)
    policy = saferl.load_policy(options.policy)
    scenario = Scenario(task="mixed").as_test()
    sides: dict[str, Callable[[], int]] = {}
    for batch in options.batches:
        road = BatchedIntersection(scenario, batch)
        seen = road.reset(seeds=scenario.episodes(0, batch))
        for _ in range(options.decisions):
            seen = road.step_mdp(road.step(policy(seen)))
        now = road.state_dict()
        roads: dict[str, EnvBase] = {"without": road}
        for name, kind in PREDICTIONS.items():
            again = BatchedIntersection(scenario, batch)
            roads[name] = TransformedEnv(again, Shield(kind()))
        for name, env in roads.items():
            base = env if env is road else env.base_env  # pyright: ignore[reportAttributeAccessIssue]

            def decide(env: EnvBase = env, base: EnvBase = base, seen=seen, now=now) -> int:
                base.load_state_dict(now)
                with torch.no_grad():
                    env.step(policy(seen.clone()))
                return 1

            decide()
            sides[f"{name} {batch}"] = decide

    rates = alternate(sides, options)
    took = {name: 1e3 / rate for name, rate in medians(rates).items()}
    print(f"{conditions(options)}, {options.policy}")
    print(f"{'scenes':>8s}{'without ms':>12s}" + "".join(f"{n + ' ms':>22s}{'ratio':>8s}" for n in PREDICTIONS))  # fmt: skip
    figures: dict = {"rounds": rates, "conditions": conditions(options)}
    for batch in options.batches:
        alone = took[f"without {batch}"]
        row = f"{batch:8d}{alone:12.1f}"
        for name in PREDICTIONS:
            mine = took[f"{name} {batch}"]
            row += f"{mine:22.1f}{mine / alone:8.1f}"
            figures[f"ratio_{name.replace(' ', '_')}_{batch}"] = mine / alone
        print(row)
    write(options.json, figures)


if __name__ == "__main__":
    main()
