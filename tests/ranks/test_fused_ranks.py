"""The fused gradient steps of PPO take the same means over ranks as torch's: gloo and Triton's interpreter."""

import pytest
import torch

from ksim_rl import ranks
from ksim_rl.objectives import PPOCfg
from tests.algorithms.fused_problem import assert_equal_states, networks, rollout, update
from tests.ranks.gloo import results

pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(
        torch.cuda.is_available(), reason="without CUDA the interpreter runs the kernels"
    ),
]


def both(fused_ppo):
    """Update by torch and by the kernels on this rank's own rollouts; return weights and learning rate."""
    cfg = PPOCfg(num_epochs=1, learning_rate=3e-3, desired_kl=1e-4)
    actor, critic = networks()
    by_torch, fused = update(cfg, actor, critic), update(cfg, actor, critic, fused_ppo)
    for seed in range(2):
        data = rollout(actor, seed=10 * seed + ranks.rank())
        # So that one rank has more env states that take part than the other.
        data["next", "reward"][: 3 * ranks.rank()] = torch.nan
        by_torch(data.clone())
        fused(data)
    assert_equal_states(by_torch, fused)
    parameters = torch.cat([parameter.detach().flatten() for parameter in fused.actor.parameters()])
    return parameters, fused.optimizer.param_groups[0]["lr"].clone()


def test_fused_updates_of_two_ranks_equal_those_of_torch(tmp_path):
    fused_ppo = pytest.importorskip("ksim_rl.objectives.fused_ppo.fused_ppo").FusedPPO
    (first, rate), (second, other_rate) = results(both, fused_ppo, size=2, folder=tmp_path)
    assert torch.equal(first, second), "all ranks have the same weights, bit for bit"
    assert rate == other_rate != 3e-3
