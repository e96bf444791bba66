"""What a trained policy does wrong, and what its critics knew of it.

    python benchmarks/failures.py RUN [--episodes 1000] [--seed 777] [--show 10] [--json PATH]

Plays the run's task from the usual starts at the frequency of its training, with the mean action and no projector, so that critics are
asked about what they learned. Prints

- the episodes that were not over in time: how many stand in the box, how many elsewhere, how many are on their way, and of the
  first few where they were and how fast, every two seconds;
- what the reward critics say that standing there is worth, beside what it is worth: for ever, or as long as training lets
  a car stand (off-policy losses);
- by the risk that cost critics tell, the discounted cost that followed; and that risk in the last decisions before a crash
  (losses with cost critics of actions).
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import hydra
import torch
from cost_critics import followed
from side_by_side import write
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.algorithms.assemble import build_env, load_agent
from saferl.checkpoint.run import run_config
from saferl.envs.intersection.geometry import ARM, project, reference_lines
from saferl.envs.intersection.observation import as_world
from saferl.modules import CriticEnsemble

EDGES = (-1.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 2.0)
BOX = 18.0  # m along the route that the box and its exits take at most


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=777)
    parser.add_argument("--show", type=int, default=10)
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cfg = run_config(options.run, "RUN")
    if "route_starts" not in cfg.task:
        raise SystemExit(f"RUN must be a training on the road, got one on {cfg.task.task}.")
    # Decisions for which training lets a car stand.
    patience = hydra.utils.instantiate(cfg.task).patience
    cfg.device, cfg.task.route_starts, cfg.task.standstill = "cpu", 0.0, None
    agent = load_agent(cfg, options.run, "RUN")
    scenario = hydra.utils.instantiate(cfg.task)
    env = build_env(cfg.env, scenario, options.episodes, options.seed)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        data = env.rollout(scenario.horizon, agent.actor, break_when_any_done=False)

    after = data["next"]
    done, crash = after["done"].squeeze(-1), (after["collision"] | after["offroad"]).squeeze(-1)
    horizon = scenario.horizon - 1
    first = torch.where(done.any(1), done.int().argmax(1), horizon)
    late = ((first == horizon) & ~after["success"][:, horizon, 0] & ~crash[:, horizon]).nonzero()
    late = late.squeeze(-1)
    ego, _ = as_world(data["ego"], data["vehicles"])
    _, s, _ = project(ego[..., 1:3], reference_lines(data["route"].squeeze(-1), ego)[..., 0, :, :])
    s, speed = s - ARM, ego[..., 3]
    stands = late[speed[late, horizon] < 0.5]
    inside = ((s[stands, horizon] > 0) & (s[stands, horizon] < BOX + 2)).sum().item()
    figures: dict = {
        "episodes": options.episodes,
        "not over": len(late),
        "standing in the box": inside,
        "standing elsewhere": len(stands) - inside,
        "on their way": len(late) - len(stands),
    }
    print(", ".join(f"{key} {value}" for key, value in figures.items()))
    each = 2 * scenario.policy_frequency
    for index in late[: options.show].tolist():
        where = ", ".join(
            f"{float(place):.0f} m at {float(pace):.1f}"
            for place, pace in zip(s[index, ::each], speed[index, ::each], strict=True)
        )
        print(f"  episode {index}, route {int(data['route'][index, 0])}: {where}")

    loss = agent.loss
    if len(stands) and hasattr(loss, "qvalue_network"):
        states = data[stands, horizon]
        critics = CriticEnsemble(
            loss.qvalue_network, params=loss.qvalue_network_params, reduce="min"
        )
        with torch.no_grad():
            values = critics.values(states).amin(0).flatten()
        earned = after["reward"][stands, horizon, 0].mean().item() * cfg.learning.reward_scale
        # A critic does not see for how long a car has stood: each decision may be the last of so many.
        worth = earned / (1 - cfg.gamma * (1 - 1 / patience))
        figures["value of standing"], figures["worth of standing"] = values.tolist(), worth
        print(
            f"standing is worth {values.min():.2f} to {values.max():.2f} (median {values.median():.2f}) by the reward critics, "
            f"{worth:.2f} in training, {earned / (1 - cfg.gamma):.2f} for ever"
        )
    if "action" not in getattr(getattr(loss, "cost_value", None), "in_keys", ()):
        write(options.json, figures)
        return

    with torch.no_grad():
        risk = (
            loss.cost_value(data.reshape(-1)).get(loss.cost_value.out_keys[0]).reshape(done.shape)
        )
    follows, known = followed(data, cfg.gamma)
    print(
        f"Q_c {risk[known].mean():.3f}, what follows {follows[known].mean():.3f}, {int(known.sum())} states of "
        "episodes that ended before their time"
    )
    rows = []
    for low, high in itertools.pairwise(EDGES):
        those = known & (risk >= low) & (risk < high)
        if those.any():
            rows.append((risk[those].mean().item(), follows[those].mean().item(), int(those.sum())))
            print("  Q_c {:.3f}: {:.3f} follows, {} states".format(*rows[-1]))
    figures["calibration"] = rows
    crashes = (crash & after["terminated"].squeeze(-1)).nonzero().tolist()
    figures["before a crash"] = {}
    for ahead in (0, 2, 4, 6, 8, 10):
        values = [
            risk[n, t - ahead].item()
            for n, t in crashes
            if t >= ahead and not done[n, t - ahead : t].any()
        ]
        if values:
            median = torch.tensor(values).median().item()
            figures["before a crash"][ahead] = median
            seconds = ahead / scenario.policy_frequency
            print(f"  {seconds:.1f} s before a crash: median Q_c {median:.3f} of {len(values)}")
    write(options.json, figures)


if __name__ == "__main__":
    main()
