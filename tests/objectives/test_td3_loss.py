"""TD3's losses against TorchRL's own, with the same networks, numbers and draws."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl import objectives

from ksim_rl.objectives import TD3Loss
from tests.objectives.test_sac_loss import (
    ACTION,
    OBS,
    assert_gradients_are_alike,
    for_torchrl,
    minibatch,
    move_targets,
    networks,
    with_extra,
)


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("extra", ["", "mask", "weights"])
@pytest.mark.parametrize("num_networks", [1, 2, 3])
def test_losses_and_gradients_are_those_of_torchrl(num_networks, extra):
    _, critic = networks(num_networks=num_networks)
    net = nn.Sequential(nn.Linear(OBS, ACTION), nn.Tanh())
    # TorchRL shows its critics nothing but what the actor reads.
    actor = TensorDictModule(net, in_keys=["critic"], out_keys=["action"])
    # TorchRL's noise is in units of the action, ours of half its range.
    bound = torch.full((ACTION,), 0.8)
    noise = {"target_noise": 0.5, "target_noise_clip": 0.6}
    ours = TD3Loss(actor, critic, gamma=0.95, low_L=-bound, high_L=bound, **noise)
    stock = objectives.TD3Loss(
        actor,
        for_torchrl(critic),
        num_qvalue_nets=num_networks,
        loss_function="l2",
        policy_noise=0.8 * 0.5,
        noise_clip=0.8 * 0.6,
        delay_actor=False,
        bounds=(-0.8, 0.8),
    )
    stock.make_value_estimator(gamma=0.95)
    move_targets(ours, stock)
    data = with_extra(minibatch(), extra)
    results, gradients = [], []
    for loss in (ours, stock):
        torch.manual_seed(3)
        out = loss(data.clone())
        actor.zero_grad()
        (out["loss_qvalue"] + out["loss_actor"]).backward()
        # With several critics TorchRL's actor climbs the first, ours the lowest.
        results.append(out.select("loss_qvalue", *(["loss_actor"] if num_networks == 1 else [])))
        gradients.append([parameter.grad.clone() for parameter in actor.parameters()])
    for name in results[0].keys():
        torch.testing.assert_close(
            results[0][name], results[1][name], rtol=1e-5, atol=1e-6, msg=name
        )
    if num_networks == 1:
        torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-5, atol=1e-6)
    else:
        assert_gradients_are_alike(critic, stock)


def test_bounds_and_atoms_move_with_the_networks():
    actor, critic = networks()
    bound = torch.ones(ACTION)
    loss = TD3Loss(
        actor, critic, low_L=-bound, high_L=bound, support_A=torch.linspace(-1.0, 1.0, 5)
    )
    state = loss.state_dict()
    moved = loss.to("meta")
    for own in (moved.low_L, moved.high_L, moved.support_A):
        assert own.device.type == "meta"
    # They follow from env and config, so that a checkpoint does not hold them.
    assert not [name for name in state if name.endswith(("low_L", "high_L", "support_A"))]
