"""The update as one CUDA graph. Skipped where there is no GPU."""

import copy

import pytest
import torch

from ksim_rl.data import DatasetBuffer, DatasetCfg
from ksim_rl.device.capture import Captured
from ksim_rl.modules import update_normalizers
from ksim_rl.objectives import (
    PPOCfg,
    StepGuard,
    make_advantage,
    make_loss,
    make_optimizer,
    ppo_step,
)
from tests.gpu.no_syncs import no_syncs
from tests.objectives.problems import networks, rollout

pytestmark = pytest.mark.gpu
CFG = PPOCfg(num_epochs=3)


class _Update:
    def __init__(self, actor, critic, data):
        self.actor, self.critic, self.data = (
            copy.deepcopy(actor),
            copy.deepcopy(critic),
            data.clone(),
        )
        self.loss = make_loss(CFG, self.actor, self.critic)
        self.optimizer = make_optimizer(CFG, self.actor, self.critic)
        self.gae = make_advantage(CFG, self.actor, self.critic)
        sizes = DatasetCfg(num_env_states_per_minibatch=128, num_minibatches=4)
        self.dataset = DatasetBuffer(sizes, keys=self.loss.dataset_keys)
        self.guard = StepGuard(device="cuda")
        self.kl = torch.zeros((), device="cuda")

    def __call__(self):
        self.dataset.extend(self.gae(self.data))
        for _ in range(CFG.num_epochs):
            for minibatch_B in self.dataset.epoch():
                metrics = ppo_step(
                    self.loss, self.optimizer, minibatch_B, cfg=CFG, guard=self.guard
                )
        self.kl.copy_(metrics["kl"])
        update_normalizers(self.data, self.actor, self.critic)

    def parameters(self):
        return [*self.actor.parameters(), *self.critic.parameters()]


@pytest.fixture
def parts():
    actor, critic = networks()
    return (
        actor.to("cuda"),
        critic.to("cuda"),
        rollout(actor.to("cuda"), num_envs=64, length=8, device="cuda"),
    )


def test_no_host_sync(parts):
    update = _Update(*parts)
    update()
    with no_syncs():
        update()


def test_captured_updates_equal_eager_ones(parts):
    eager, captured = _Update(*parts), _Update(*parts)
    graph = Captured(captured, device="cuda", require_graphs=True)
    for iteration in range(5):
        # New numbers at the same addresses, as a rollout collector gives them; one is not finite.
        reward = torch.randn_like(eager.data["next", "reward"])
        reward[iteration, 2] = float("nan")
        for update in (eager, captured):
            update.data["next", "reward"].copy_(reward)
        eager()
        graph()
        torch.testing.assert_close(captured.kl, eager.kl, atol=1e-4, rtol=1e-3)
    assert graph.ready
    for one, other in zip(captured.parameters(), eager.parameters(), strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-3)
    assert int(captured.dataset.non_finite_count) == int(eager.dataset.non_finite_count) == 5
    assert captured.dataset.sampler.state_dict() == eager.dataset.sampler.state_dict()
    assert int(captured.guard.skipped) == 0
    rates = [update.optimizer.param_groups[0]["lr"] for update in (captured, eager)]
    torch.testing.assert_close(*rates)
