"""What OmniSafe's own code computes on small fixed networks and batches, for a test of our losses.

    python benchmarks/omnisafe_losses.py --json tests/fixtures/omnisafe.json

Runs in the environment that ``benchmarks/omnisafe_sac_lag.py`` describes, which has no saferl. The algorithms
are made without their ``__init__``, which would want an environment; their networks, optimisers, buffers
and multipliers come from their own ``_init_model`` and ``_init``, and every number from their own methods:

- ``SACLag``: the losses of the reward critics, the cost critic, the actor and the temperature.
- ``PPOLag``: advantages and value targets of the buffer, the weighed advantage, the clipped objective and
  the losses of the two values.
- ``CPO``: both surrogates, the KL, a Fisher product, and ``_update_actor`` from the gradients to the step
  that the search accepts, for a violation of each case.
- ``Lagrange``: a multiplier moved by gradient ascent.

In float64, but for the buffer, which is float32 as OmniSafe has it: its ``discount_cumsum`` overwrites rewards
that are float64 already. Defaults are kept but for these: learning rates are 0, so that an update leaves its gradient
and moves nothing; gradients are not clipped and weights not penalised, which is not a matter of the losses;
the temperature is learned; and CPO's conjugate gradients run without the 1e-6 in their denominators and to
the end, as a solution that depends on the scale of the advantages cannot be compared with another one.

tests/objectives/test_omnisafe.py reads the result.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omnisafe_agents import (
    ACTION,
    OBSERVATION,
    bare,
    disturb,
    draws,
    gradients,
    on_policy,
    weights,
)
from omnisafe_sac_lag import array_defaults

with array_defaults():
    from omnisafe.algorithms.off_policy.sac_lag import SACLag
    from omnisafe.algorithms.on_policy.naive_lagrange.ppo_lag import PPOLag
    from omnisafe.algorithms.on_policy.second_order import cpo
    from omnisafe.common.lagrange import Lagrange
    from omnisafe.utils.math import conjugate_gradients
    from omnisafe.utils.tools import (
        get_flat_gradients_from,
        get_flat_params_from,
        set_param_values_to_model,
    )

#: Violations as shares of the one beyond which the trust region and the constraint do not meet: one in each case
#: of a plain step, and two in each of the quadratic ones, where the constraint may or may not bend the step.
SHARES = (-1.5, -0.8, -0.1, 0.4, 0.8, 1.5)


def sac_lag() -> dict[str, Any]:
    torch.manual_seed(0)
    alpha, multiplier, count = 0.3, 0.7, 16
    agent = bare(
        SACLag, "off-policy", algo_cfgs={"auto_alpha": True, "max_grad_norm": 0, "gamma": 0.9}
    )
    networks = agent._actor_critic
    disturb(networks.target_reward_critic, 0.3)
    disturb(networks.target_cost_critic, 0.3)
    agent._log_alpha.data.fill_(alpha).log_()
    agent._lagrange.lagrangian_multiplier.data.fill_(multiplier)
    batch = {
        "obs": torch.randn(count, OBSERVATION),
        "act": torch.randn(count, ACTION).tanh(),
        "reward": torch.randn(count),
        "cost": torch.rand(count),
        "done": (torch.arange(count) % 4 == 1).double(),
        "next_obs": torch.randn(count, OBSERVATION),
    }
    noise = {"next": torch.randn(count, ACTION), "now": torch.randn(count, ACTION)}
    critic_input = [batch[key] for key in ("obs", "act")], [batch["done"], batch["next_obs"]]

    with draws(noise["next"]):
        agent._update_reward_critic(*critic_input[0], batch["reward"], *critic_input[1])
    reward_gradients = gradients(networks.reward_critic)
    # No draw: the next action is the policy's mean.
    agent._update_cost_critic(*critic_input[0], batch["cost"], *critic_input[1])
    cost_gradients = gradients(networks.cost_critic)
    with draws(noise["now"], noise["now"]):  # of the actor's loss, then the temperature's
        agent._update_actor(batch["obs"])
    return {
        "settings": {
            "gamma": agent._cfgs.algo_cfgs.gamma,
            "alpha": agent._alpha,
            "lagrangian_multiplier": agent._lagrange.lagrangian_multiplier.item(),
            "target_entropy": agent._target_entropy,
        },
        "weights": {
            name: weights(getattr(networks, name))
            for name in (
                "actor",
                "reward_critic",
                "target_reward_critic",
                "cost_critic",
                "target_cost_critic",
            )
        },
        "batch": batch,
        "noise": noise,
        "losses": {
            "reward_critic": agent._logger.stored["Loss/Loss_reward_critic"],
            "cost_critic": agent._logger.stored["Loss/Loss_cost_critic"],
            "actor": agent._logger.stored["Loss/Loss_pi"],
            "alpha": agent._logger.stored["Loss/alpha_loss"],
        },
        "gradients": {
            "reward_critic": reward_gradients,
            "cost_critic": cost_gradients,
            "actor": gradients(networks.actor),
            "log_alpha": agent._log_alpha.grad,
        },
    }


def ppo_lag() -> dict[str, Any]:
    torch.manual_seed(1)
    agent, record = on_policy(PPOLag)
    agent._lagrange.lagrangian_multiplier.data.fill_(0.7)
    networks, log = agent._actor_critic, agent._logger.stored
    batch, buffer = record["batch"], record["buffer"]
    disturb(networks.actor, 0.2)  # no longer the policy that acted
    agent._update_reward_critic(batch["obs"], buffer["target_value_r"])
    agent._update_cost_critic(batch["obs"], buffer["target_value_c"])
    advantages = buffer["adv_r"], buffer["adv_c"]
    agent._update_actor(batch["obs"], batch["act"], batch["logp"], *advantages)
    record["settings"] |= {
        "clip": agent._cfgs.algo_cfgs.clip,
        "lagrangian_multiplier": agent._lagrange.lagrangian_multiplier.item(),
    }
    record["weights"]["actor_after"] = weights(networks.actor)
    return record | {
        "advantage": agent._compute_adv_surrogate(*advantages),
        "ratio": log["Train/PolicyRatio"].detach(),
        "losses": {
            "actor": log["Loss/Loss_pi"],
            "reward_critic": log["Loss/Loss_reward_critic"],
            "cost_critic": log["Loss/Loss_cost_critic"],
        },
        "gradients": {
            name: gradients(getattr(networks, name))
            for name in ("actor", "reward_critic", "cost_critic")
        },
    }


def update(agent: Any, inputs: tuple[torch.Tensor, ...], violation: float) -> dict[str, Any]:
    """``CPO._update_actor`` from where the actor is, to which it then returns."""
    start, seen = get_flat_params_from(agent._actor_critic.actor).clone(), {}

    def listen(name: str) -> None:
        method = getattr(cpo.CPO, name)

        def listening(**arguments: Any) -> Any:
            seen[name] = arguments
            return method(agent, **arguments)

        setattr(agent, name, listening)

    for name in ("_determine_case", "_step_direction", "_cpo_search_step"):
        listen(name)
    agent._logger.episode_cost = agent._cfgs.algo_cfgs.cost_limit + violation
    agent._update_actor(*inputs)
    moved = get_flat_params_from(agent._actor_critic.actor) - start
    set_param_values_to_model(agent._actor_critic.actor, start)
    # The same methods with the other sign of r = g H^-1 b.
    case, solve = seen["_determine_case"], seen["_step_direction"]
    flipped = {"r": -case["r"]}
    number, A, B = cpo.CPO._determine_case(agent, **case | flipped)
    assert number == solve["optim_case"]
    step, lambda_star, nu_star = cpo.CPO._step_direction(agent, **solve | flipped)
    log = agent._logger.stored
    return {
        "violation": agent._logger.episode_cost - agent._cfgs.algo_cfgs.cost_limit,
        "optim_case": number,
        "gradients": {
            "g": seen["_cpo_search_step"]["grads"],
            "b": case["b_grads"],
            "H_inv_g": solve["x"],
            "H_inv_b": solve["p"],
        },
        **{key: case[key].item() for key in "qrs"},
        "A": A.item(),
        "B": B.item(),
        "step_direction": seen["_cpo_search_step"]["step_direction"],
        "Lambda_star": log["Misc/Lambda_star"],
        "Nu_star": log["Misc/Nu_star"],
        "acceptance_step": log["Misc/AcceptanceStep"],
        "moved": moved,
        "other_sign": {
            "step_direction": step,
            "Lambda_star": lambda_star.item(),
            "Nu_star": nu_star.item(),
        },
    }


def constrained() -> dict[str, Any]:
    torch.manual_seed(3)
    # As many iterations as there are parameters solve a system but for rounding; some more remove that.
    agent, record = on_policy(cpo.CPO, cg_iters=100)
    actor, log = agent._actor_critic.actor, agent._logger.stored
    batch, buffer = record["batch"], record["buffer"]
    inputs = (batch["obs"], batch["act"], batch["logp"])
    for key in ("adv_r", "adv_c"):  # which the buffer has centred, to the precision of float32
        buffer[key] -= buffer[key].mean()
    default = cpo.conjugate_gradients
    assert default is conjugate_gradients
    cpo.conjugate_gradients = partial(conjugate_gradients, eps=0.0)

    # The cost's gradient may point the reward's way or against it: one of them with the cost's advantages as
    # they are, the other one with their negatives.
    steps = {}
    for sign in (1.0, -1.0):
        advantages = buffer["adv_r"], sign * buffer["adv_c"]
        probe = update(agent, (*inputs, *advantages), 0.0)
        edge = (2 * agent._cfgs.algo_cfgs.target_kl * probe["s"]) ** 0.5
        trials = [update(agent, (*inputs, *advantages), share * edge) for share in SHARES]
        for trial in trials:  # the same for each
            shared = trial.pop("gradients")
        steps["aligned" if probe["r"] > 0 else "opposed"] = {
            "sign": sign,
            **shared,
            "trials": trials,
        }

    agent._fvp_obs = batch["obs"]
    start = get_flat_params_from(actor).clone()
    vector = torch.randn_like(start)
    product = agent._fvp(vector)
    with torch.no_grad():
        before = actor(batch["obs"])
    change = 0.2 * torch.randn_like(start)
    # One trial of the search is the KL's own place; whether it accepts is of no account here.
    agent._cpo_search_step = partial(cpo.CPO._cpo_search_step, agent)
    advantages = buffer["adv_r"], buffer["adv_c"]
    agent._cpo_search_step(
        change, change, before, *inputs, *advantages, *torch.zeros(2), total_steps=1
    )
    kl = log["Train/KL"]
    set_param_values_to_model(actor, start + change)
    surrogates = {}
    for name, loss, advantage in (
        ("reward", agent._loss_pi, buffer["adv_r"]),
        ("cost", agent._loss_pi_cost, buffer["adv_c"]),
    ):
        actor.zero_grad()
        value = loss(*inputs, advantage)
        value.backward()
        surrogates[name] = {"loss": value.item(), "gradient": get_flat_gradients_from(actor)}
    record["weights"]["actor_after"] = weights(actor)
    record["settings"] |= {key: agent._cfgs.algo_cfgs[key] for key in ("target_kl", "cg_damping")}
    return record | {
        "order": [name for name, _ in actor.named_parameters()],
        "surrogates": surrogates,
        "kl": kl.item(),
        "fisher": {"vector": vector, "product": product},
        "steps": steps,
    }


def multiplier() -> dict[str, Any]:
    """Gradient ascent, which OmniSafe offers beside Adam: up, down, and against the floor at 0."""
    lagrange = Lagrange(25.0, 0.3, 0.01, "SGD")
    costs, values = [40.0, 10.0, 30.0, 0.0, 0.0, 26.0], []
    for cost in costs:
        lagrange.update_lagrange_multiplier(cost)
        values.append(lagrange.lagrangian_multiplier.item())
    return {"cost_limit": 25.0, "init": 0.3, "lr": 0.01, "costs": costs, "values": values}


def plain(value: Any) -> Any:
    """Tensors as lists."""
    if isinstance(value, torch.Tensor):
        return value.tolist()
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [plain(entry) for entry in value]
    return value


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write weights, batches and numbers here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    with contextlib.redirect_stdout(sys.stderr):  # OmniSafe says which files it loads
        parts = {
            "sac_lag": sac_lag(),
            "ppo_lag": ppo_lag(),
            "cpo": constrained(),
            "multiplier": multiplier(),
        }
    source = "OmniSafe 0.5.0, its own methods called by benchmarks/omnisafe_losses.py"
    found = plain({"source": source, **parts})
    print(json.dumps(found))
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
