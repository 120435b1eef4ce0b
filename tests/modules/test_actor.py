import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from ksim_rl import dims
from ksim_rl.modules import ActorCfg, DiagonalGaussian, make_actor
from ksim_rl.testing import count_syncs

CFGS = [
    ActorCfg(hidden_dims=(16, 8)),
    ActorCfg(hidden_dims=(), obs_normalization=False, std_type="log"),
    ActorCfg(hidden_dims=(16,), state_dependent_std=True, init_std=0.3),
]


def _data(*shape):
    return TensorDict({"actor": torch.randn(*shape, 5)}, shape)


@pytest.mark.parametrize("cfg", CFGS)
@pytest.mark.parametrize("shape", [(4,), (4, 3)])
def test_writes_what_torchrl_losses_read(cfg, shape):
    actor = make_actor(cfg, obs_dim=5, action_dim=2)
    assert isinstance(actor, ProbabilisticActor)
    out = actor(_data(*shape))
    assert out["loc"].shape == out["scale"].shape == out["action"].shape == (*shape, 2)
    assert out["action_log_prob"].shape == shape
    expected = DiagonalGaussian(out["loc"], out["scale"]).log_prob(out["action"])
    torch.testing.assert_close(out["action_log_prob"], expected)


@pytest.mark.parametrize("cfg", CFGS)
def test_observations_of_another_size_are_refused(cfg):
    with pytest.raises(
        ValueError, match="built for obs_dim=7, and reads observations of 5 numbers"
    ):
        make_actor(cfg, obs_dim=7, action_dim=2)(_data(4))


def test_first_policy_acts_around_zero_with_init_std():
    actor = make_actor(ActorCfg(hidden_dims=(64, 64), init_std=0.5), obs_dim=5, action_dim=2)
    out = actor(_data(1000))
    assert out["loc"].abs().max() < 0.1
    torch.testing.assert_close(out["scale"], torch.full((1000, 2), 0.5))


def test_samples_by_default_and_is_deterministic_on_request():
    actor, data = make_actor(CFGS[0], obs_dim=5, action_dim=2), _data(4)
    assert not torch.equal(actor(data.clone())["action"], actor(data.clone())["action"])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        out = actor(data)
    assert torch.equal(out["action"], out["loc"])


def test_in_key_and_action_spec():
    spec = Bounded(low=-1.0, high=1.0, shape=(4, 2))
    actor = make_actor(ActorCfg(in_keys=(("obs", "policy"),)), obs_dim=5, action_spec=spec)
    data = TensorDict({"obs": {"policy": torch.randn(4, 5)}}, [4])
    assert actor(data)["action"].shape == (4, 2)
    assert actor.in_keys == [("obs", "policy")]


def test_names_of_the_batch_dims_are_kept():
    data = dims.name(_data(4), dims.E)
    assert make_actor(CFGS[0], obs_dim=5, action_dim=2)(data).names == [dims.E]


def test_same_seed_gives_the_same_network():
    networks = []
    for _ in range(2):
        torch.manual_seed(3)
        networks.append(make_actor(CFGS[0], obs_dim=5, action_dim=2))
    for one, other in zip(*(network.parameters() for network in networks), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("cfg", CFGS)
def test_no_host_sync(cfg):
    actor, data = make_actor(cfg, obs_dim=5, action_dim=2), _data(4)
    with count_syncs() as syncs:
        actor(data)
    assert syncs.total == 0, syncs.report()


def test_compiles_without_a_break():
    actor, data = make_actor(CFGS[0], obs_dim=5, action_dim=2), _data(4)
    compiled = torch.compile(actor, fullgraph=True, backend="aot_eager")
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(compiled(data.clone())["action"], actor(data.clone())["action"])
    with torch.no_grad():
        assert torch.compile(lambda td: actor(td), fullgraph=True, backend="aot_eager")(data)[
            "action"
        ].shape == (4, 2)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"hidden_dims": (0,)}, r"hidden_dims\[0\]=0"),
        ({"activation": "rely"}, "activation='rely'.*'relu'"),
        ({"init_std": 0.0}, "init_std=0.0"),
        ({"std_type": "logarithm"}, "std_type='logarithm'"),
        ({"output_gain": -1.0}, "output_gain=-1.0"),
    ],
)
def test_config_refusals_name_the_field(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ActorCfg(**kwargs)
