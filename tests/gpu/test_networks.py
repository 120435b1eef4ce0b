"""Policies of every distribution inside CUDA graphs. Skipped where there is no GPU."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, OneHot, Unbounded

from ksim_rl.device.capture import Captured
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import PPOCfg, make_loss, make_optimizer, ppo_step
from tests.gpu.no_syncs import no_syncs

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

SIZE = 4096
BOX = Bounded(-2.0, 1.0, (1, 2))
SPECS = {
    "gaussian": ("gaussian", Unbounded((1, 2))),
    "tanh_gaussian": ("tanh_gaussian", BOX),
    "truncated_gaussian": ("truncated_gaussian", BOX),
    "index": ("categorical", Categorical(3, shape=(1,))),
    "one_hot": ("categorical", OneHot(3, shape=(1, 3))),
    "several": ("categorical", MultiCategorical([3, 2], shape=(1, 2))),
    "mixed": (
        "tanh_gaussian",
        Composite(
            action=Composite(arm=BOX, grip=Categorical(3, shape=(1,)), shape=(1,)), shape=(1,)
        ),
    ),
}


def _networks(name):
    torch.manual_seed(0)
    distribution, spec = SPECS[name]
    cfg = ActorCfg(hidden_dims=(32,), distribution=distribution, init_std=0.5, output_gain=0.5)
    return make_actor(cfg, obs_dim=5, action_spec=spec, device="cuda"), make_critic(
        CriticCfg(hidden_dims=(32,)), obs_dim=5, device="cuda"
    )


def _observations():
    return TensorDict(
        {
            "actor": torch.randn(SIZE, 5, device="cuda"),
            "critic": torch.randn(SIZE, 5, device="cuda"),
        },
        [SIZE],
    )


@pytest.mark.parametrize("name", SPECS)
@torch.no_grad()
def test_captured_policies_draw_anew_and_score_what_they_draw(name):
    actor, data = _networks(name)[0], _observations()
    out = actor(data.clone())
    kept = [key for key in out.keys(True, True) if key not in ("actor", "critic")]
    buffers = out.clone()

    def act():
        result = actor(data.clone())
        for key in kept:
            buffers.get(key).copy_(result.get(key))

    graph = Captured(act, device="cuda", require_graphs=True)
    draws = []
    for call in range(6):
        with no_syncs(on=call > 3):
            graph()
        draws.append(buffers.clone())
    assert graph.ready
    action_key = ("action", "arm") if name == "mixed" else "action"
    assert not torch.equal(draws[-1].get(action_key), draws[-2].get(action_key)), (
        "each replay draws new numbers"
    )
    dist = actor.get_dist(data.clone())
    drawn = draws[-1]
    if name == "mixed":
        expected = dist.log_prob(drawn.select("action"))
        for key in (("action", "arm_log_prob"), ("action", "grip_log_prob")):
            torch.testing.assert_close(drawn[key], expected[key], atol=1e-3, rtol=1e-3)
        return
    log_prob = dist.log_prob(drawn["action"])
    torch.testing.assert_close(drawn["action_log_prob"], log_prob, atol=1e-3, rtol=1e-3)
    # A sample of the right distribution has a mean log-probability of minus the entropy.
    entropy = -dist.log_prob(dist.sample((50,))).mean(0)
    error = (log_prob + entropy).mean() / ((log_prob + entropy).std() / math.sqrt(SIZE))
    assert error.abs() < 5.0


@pytest.mark.parametrize("name", SPECS)
def test_captured_gradient_steps_equal_eager_ones_where_nothing_is_drawn(name):
    actor, critic = _networks(name)
    data = _observations()
    with torch.no_grad():
        critic(actor(data))
        data["advantage"], data["value_target"] = torch.randn(2, SIZE, 1, device="cuda")
    # The entropy of a squashed gaussian is a sample, which differs between the two.
    cfg = PPOCfg(schedule="adaptive", entropy_coeff=0.0)
    results = []
    for captured in (False, True):
        networks = _networks(name)
        loss, optimizer = make_loss(cfg, *networks), make_optimizer(cfg, *networks)

        def step(loss=loss, optimizer=optimizer):
            ppo_step(loss, optimizer, data, cfg=cfg)

        run = Captured(step, device="cuda", require_graphs=True) if captured else step
        for call in range(6):
            with no_syncs(on=call > 3):
                run()
        results.append([parameter for network in networks for parameter in network.parameters()])
    for eager, replayed in zip(*results, strict=True):
        assert replayed.isfinite().all()
        torch.testing.assert_close(replayed, eager, atol=1e-4, rtol=1e-3)
