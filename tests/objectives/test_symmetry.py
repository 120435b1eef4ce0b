"""Mirrored samples and the mirror loss: closed forms, policies that are symmetric, and one that becomes so."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, ValueOperator

from ksim_rl.data import DatasetCfg
from ksim_rl.modules import ActorCfg, CriticCfg, DiagonalGaussian, make_actor, make_critic
from ksim_rl.objectives import (
    ClipPPOLoss,
    PPOCfg,
    SymmetricAugmentation,
    make_symmetric,
    mirror_loss,
)
from ksim_rl.testing import count_syncs
from ksim_rl.trainers import PPOUpdate
from ksim_rl.transforms import MirrorMap
from tests.objectives.problems import minibatch, networks

# Of the networks in `problems`: five numbers for the actor, seven for the critic, two actions.
MAPS = {
    "actor": MirrorMap(source=(1, 0, 2, 3, 4), signs=(1, 1, -1, 1, -1)),
    "critic": MirrorMap(source=(1, 0, 2, 3, 4, 6, 5), signs=(1, 1, -1, 1, -1, -1, -1)),
    "action": MirrorMap(source=(1, 0), signs=(-1, -1)),
}
FLIP = {"actor": MirrorMap(source=(0,), signs=(-1,)), "critic": MirrorMap(source=(0,), signs=(-1,))}
FLIP |= {"action": MirrorMap(source=(0,), signs=(-1,))}


def _affine_actor(weight, bias, scale=1.0):
    """Return a policy of one number whose mean is weight * x + bias."""

    class Affine(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight, self.bias = (
                nn.Parameter(torch.tensor(weight)),
                nn.Parameter(torch.tensor(bias)),
            )

        def forward(self, obs):
            loc = self.weight * obs + self.bias
            return loc, torch.full_like(loc, scale)

    return ProbabilisticActor(
        TensorDictModule(Affine(), in_keys=["actor"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=DiagonalGaussian,
        return_log_prob=True,
        default_interaction_type="random",
    )


def test_the_mirror_loss_has_its_closed_form_and_gradient():
    # pi(x) = w x + b: pi(-x) = -w x + b and -pi(x) = -w x - b, so the loss is (2 b)^2 whatever the states.
    actor = _affine_actor(0.7, 0.3)
    states_B = TensorDict({"actor": torch.randn(9, 1)}, [9])
    loss = mirror_loss(actor, states_B, SymmetricAugmentation(FLIP))
    assert loss.item() == pytest.approx(4 * 0.3**2, rel=1e-5)
    loss.backward()
    weight, bias = actor.parameters()
    assert weight.grad.item() == pytest.approx(0.0, abs=1e-6)
    assert bias.grad.item() == pytest.approx(8 * 0.3, rel=1e-5)
    assert mirror_loss(_affine_actor(0.7, 0.0), states_B, SymmetricAugmentation(FLIP)).item() == 0.0


def test_masked_env_states_take_no_part_in_the_mirror_loss():
    class Even(nn.Module):
        def forward(self, obs):
            return obs.square(), torch.ones_like(obs)

    actor = ProbabilisticActor(
        TensorDictModule(Even(), in_keys=["actor"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=DiagonalGaussian,
    )
    states_B = TensorDict({"actor": torch.tensor([[1.0], [2.0], [5.0]])}, [3])
    states_B["collector", "mask"] = torch.tensor([[True], [True], [False]])
    # pi(-x) + pi(x) = 2 x^2.
    expected = (2.0**2 + 8.0**2) / 2
    assert mirror_loss(actor, states_B, SymmetricAugmentation(FLIP)).item() == pytest.approx(
        expected
    )
    states_B["collector", "mask"].fill_(False)
    assert mirror_loss(actor, states_B, SymmetricAugmentation(FLIP)).item() == 0.0


def test_the_augmented_minibatch_is_the_minibatch_and_its_image():
    actor, critic = networks()
    data = minibatch(actor, critic, size=8)
    mirror = SymmetricAugmentation(MAPS)
    both = mirror(data)
    assert both.batch_size == (16,) and both.names == ["B"]
    assert (both[:8] == data).all()
    image = both[8:]
    for key in MAPS:
        assert torch.equal(image[key], MAPS[key](data[key]))
        assert not torch.equal(image[key], data[key])
    assert torch.equal(image["loc"], MAPS["action"](data["loc"]))
    assert torch.equal(image["scale"], data["scale"].flip(-1))
    for key in ("advantage", "value_target", "state_value", "action_log_prob"):
        assert torch.equal(image[key], data[key])
    twice = mirror.image(mirror.image(data))
    assert all(torch.equal(twice[key], data[key]) for key in data.keys(True, True))


class _Equivariant(nn.Module):
    """Symmetrizes a gaussian network: its mean is odd and its scale even under the maps."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, obs):
        loc, scale = self.net(obs)
        loc_of_image, scale_of_image = self.net(MAPS["actor"](obs))
        scale = 0.5 * (scale + scale_of_image.flip(-1))
        return 0.5 * (loc + MAPS["action"](loc_of_image)), scale


class _Invariant(nn.Module):
    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, obs):
        return 0.5 * (self.net(obs) + self.net(MAPS["critic"](obs)))


def _symmetric_networks():
    actor, critic = networks(obs_normalization=False)
    symmetric = ProbabilisticActor(
        TensorDictModule(
            _Equivariant(actor.module[0].module), in_keys=["actor"], out_keys=["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        distribution_class=DiagonalGaussian,
        return_log_prob=True,
        default_interaction_type="random",
    )
    return symmetric, ValueOperator(_Invariant(critic.module), in_keys=["critic"])


def test_for_symmetric_networks_images_change_no_loss_and_no_gradient():
    # What the image is given (log-probability, advantage, distribution) must be right for this to hold.
    actor, critic = _symmetric_networks()
    data = minibatch(actor, critic)
    mirror = SymmetricAugmentation(MAPS)
    assert mirror_loss(actor, data, mirror).item() == pytest.approx(0.0, abs=1e-10)
    loss = ClipPPOLoss(actor, critic, clip_value=0.1, loss_critic_type="l2", functional=False)
    results = []
    for batch in (data, mirror.image(data), mirror(data)):
        out = loss(batch)
        total = out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]
        results.append((out, torch.autograd.grad(total, list(loss.parameters()))))
    for out, gradients in results[1:]:
        for key in (
            "loss_objective",
            "loss_critic",
            "loss_entropy",
            "kl",
            "clip_fraction",
            "kl_approx",
        ):
            torch.testing.assert_close(out[key], results[0][0][key], atol=1e-6, rtol=1e-5)
        for one, other in zip(gradients, results[0][1], strict=True):
            torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("symmetry", ["loss", pytest.param("augment", marks=pytest.mark.full)])
def test_makes_no_host_sync_and_no_compiler_break(symmetry):
    actor, critic = networks()
    data = minibatch(actor, critic)
    cfg = PPOCfg(symmetry=symmetry, symmetry_coeff=0.5)
    plain = ClipPPOLoss(actor, critic, functional=False)
    loss = make_symmetric(cfg, plain, MAPS)
    with count_syncs() as syncs:
        out = loss(data)
    assert syncs.total == 0, syncs.report()
    if symmetry == "loss":
        expected = 0.5 * mirror_loss(actor, data, SymmetricAugmentation(MAPS))
        torch.testing.assert_close(out["loss_mirror"], expected)
        torch.testing.assert_close(out["loss_objective"], plain(data)["loss_objective"])
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(data)
    for key, value in out.items():
        torch.testing.assert_close(compiled[key], value)


def _half_rollout(actor, *, num_envs=32, length=4):
    """Return one-step episodes with reward -(a - 0.5 sign(x))^2; only x > 0 is ever seen."""
    obs = torch.rand(num_envs, length, 1) * 0.5 + 0.5
    data = TensorDict({"actor": obs, "critic": obs.clone()}, [num_envs, length])
    with torch.no_grad():
        actor(data)
    done = torch.ones(num_envs, length, 1, dtype=torch.bool)
    reward = -(data["action"] - 0.5).square()
    following = {"critic": obs.clone(), "reward": reward, "done": done, "terminated": done.clone()}
    data["next"] = TensorDict(following, [num_envs, length])
    return data


@pytest.mark.parametrize("symmetry", ["none", "augment", "loss"])
def test_a_policy_that_saw_one_side_acts_on_the_other_if_it_learns_the_symmetry(symmetry):
    torch.manual_seed(2)
    actor = make_actor(
        ActorCfg(hidden_dims=(32,), init_std=0.4, obs_normalization=False), obs_dim=1, action_dim=1
    )
    critic = make_critic(CriticCfg(hidden_dims=(32,), obs_normalization=False), obs_dim=1)
    cfg = PPOCfg(
        symmetry=symmetry,
        symmetry_coeff=5.0,
        num_epochs=4,
        schedule="fixed",
        learning_rate=1e-2,
        entropy_coeff=0.0,
    )
    sizes = DatasetCfg(num_env_states_per_minibatch=64, num_minibatches=2)
    update = PPOUpdate(cfg, actor=actor, critic=critic, data=sizes, mirror=FLIP)
    for _ in range(25):
        update(_half_rollout(actor))
    x_B1 = torch.linspace(0.5, 1.0, 6)[:, None]
    probe = TensorDict({"actor": torch.cat((x_B1, -x_B1))}, [12])
    with torch.no_grad():
        right_B1, left_B1 = actor.get_dist(probe).mean.chunk(2)
    assert right_B1.mean().item() == pytest.approx(0.5, abs=0.1)
    asymmetry = float((right_B1 + left_B1).abs().mean())
    if symmetry == "none":
        assert asymmetry > 0.5
    else:
        assert left_B1.mean().item() == pytest.approx(-0.5, abs=0.12)
        assert asymmetry < 0.1
    if symmetry == "loss":
        assert 0.0 <= float(update.metrics()["loss/mirror"]) < 0.1


def test_refusals():
    actor, critic = networks()
    loss = ClipPPOLoss(actor, critic)
    assert make_symmetric(PPOCfg(), loss, None) is loss
    for maps, missing in (
        (None, "'actor', 'critic', 'action'"),
        ({"actor": MAPS["actor"]}, "'critic', 'action'"),
    ):
        with pytest.raises(ValueError, match=rf"symmetry='augment'.*\[{missing}\]"):
            make_symmetric(PPOCfg(symmetry="augment"), loss, maps)
    with pytest.raises(ValueError, match="mirror image of .*'action'"):
        SymmetricAugmentation({"actor": MAPS["actor"]})


def test_every_second_transition_is_reflected_with_what_follows_it():
    mirror = SymmetricAugmentation(MAPS)

    def observed():
        return {"actor": torch.randn(6, 5), "critic": torch.randn(6, 7)}

    before_B = TensorDict(
        {
            **observed(),
            "action": torch.randn(6, 2),
            "next": {**observed(), "reward": torch.randn(6, 1)},
        },
        [6],
    )
    after_B = before_B.clone()
    mirror.reflect_every_second_(after_B)
    image_B = mirror.image(before_B)
    image_B["next"] = mirror.image(before_B["next"])
    assert (after_B[0::2] == before_B[0::2]).all()
    assert (after_B[1::2] == image_B[1::2]).all()
    assert not (image_B["next", "critic"] == before_B["next", "critic"]).all()
    assert (after_B["next", "reward"] == before_B["next", "reward"]).all()
    mirror.reflect_every_second_(after_B)
    torch.testing.assert_close(after_B["action"], before_B["action"])


@pytest.mark.parametrize("maps", [None, {"action": FLIP["action"]}])
def test_networks_whose_mirror_image_is_missing_are_refused(maps):
    with pytest.raises(ValueError, match="mirror image of .*'actor'"):
        SymmetricAugmentation(maps, read=["actor"])
