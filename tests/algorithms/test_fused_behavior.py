"""The policy that collects equals the policy of the fused kernels' first gradient step, in Triton's interpreter."""

import copy

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.objectives import PPOCfg
from tests.algorithms.fused_problem import (
    column,
    finite,
    needs_interpreter,
    networks,
    rollout,
    to_eleven_bits,
    update,
)


def by_hand(network, obs, rounded):
    """Return the means of an MLP that has what it multiplies `rounded`."""
    hidden = network.observe(obs)
    for layer in network.trunk[::2]:
        hidden = torch.nn.functional.elu(rounded(hidden) @ rounded(layer.weight).mT + layer.bias)
    return rounded(hidden) @ rounded(network.head.loc.weight).mT + network.head.loc.bias


@needs_interpreter
@pytest.mark.parametrize(
    ("precision", "normalized"),
    [("high", True), pytest.param("highest", False, marks=pytest.mark.full)],
)
def test_who_collects_is_the_policy_of_the_first_gradient_step(fused_ppo, precision, normalized):
    torch.set_float32_matmul_precision(precision)
    rounded = to_eleven_bits if precision == "high" else torch.clone
    actor, critic = networks(actor_obs=40, obs_normalization=normalized)
    # Outside of the clip interval is a ratio that is not one to rounding.
    cfg = PPOCfg(num_epochs=1, schedule="fixed", learning_rate=1e-2, clip_epsilon=1e-5)
    made, clipped = update(cfg, actor, critic, fused_ppo), []
    network = made.actor[0].module
    # Before the first update, after it, and as torch acts.
    for acting in (made.behavior, made.behavior, made.actor):
        data = rollout(made.actor, seed=len(clipped)).apply(finite)
        with torch.no_grad():
            acted = acting(data.select("actor"))
            near = by_hand(network, data["actor"], rounded)
            torch.testing.assert_close(acted["loc"], network(data["actor"])[0], atol=5e-3, rtol=0.0)
        if acting is not made.actor:
            # Not of each: what lies between two numbers may be rounded to the other one.
            assert (acted["loc"] - near).abs().median() < 1e-5
            scored = made.actor.build_dist_from_params(acted).log_prob(acted["action"])
            torch.testing.assert_close(acted["action_log_prob"], scored)
            assert torch.equal(acted["scale"], network(data["actor"])[1])
        made(data.update(acted))
        clipped.append(made.fused._summary[0, column("clip_fraction")].item())
    assert clipped[:2] == [0.0, 0.0]
    assert (clipped[2] > 0.5) == (precision == "high")


@needs_interpreter
def test_who_collects_has_the_weights_of_the_modules_at_each_call_or_where_a_steady_begins(
    fused_ppo,
):
    actor, critic = networks()
    made = update(PPOCfg(), actor, critic, fused_ppo)
    behavior, data = made.behavior, rollout(actor).select("actor").apply(finite)
    kept = copy.deepcopy(made.state_dict())

    def means():
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            acted = behavior(data.clone())
        assert torch.equal(acted["action"], acted["loc"])
        return acted["loc"]

    first = means()
    with torch.no_grad():
        made.actor[0].module.head.loc.bias += 0.5
    changed = means()
    torch.testing.assert_close(changed, first + 0.5)
    with behavior.steady():
        made.load_state_dict(kept)
        assert torch.equal(means(), changed)
    assert torch.equal(means(), first)


def test_without_chained_kernels_the_actor_itself_collects(fused_ppo):
    actor, critic = networks(hidden=(48, 16))
    made = update(PPOCfg(), actor, critic)
    assert made.behavior is made.actor
    made = update(PPOCfg(), actor, critic, fused_ppo)
    assert made.behavior is made.actor
