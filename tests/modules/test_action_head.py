"""The policy that an env's action spec and `ActorCfg.distribution` ask for."""

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    Unbounded,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import modules
from ksim_rl.modules import ActorCfg, make_actor
from ksim_rl.testing import count_syncs

LOW, HIGH = torch.tensor([-2.0, 1.0]), torch.tensor([1.0, 3.0])
BOX = Bounded(low=LOW.expand(4, 2), high=HIGH.expand(4, 2), shape=(4, 2))
MIXED = Composite(
    action=Composite(arm=BOX, grip=Categorical(3, shape=(4,)), shape=(4,)), shape=(4,)
)
SPECS = {
    "gaussian": ("gaussian", Unbounded((4, 2))),
    "tanh_gaussian": ("tanh_gaussian", BOX),
    "truncated_gaussian": ("truncated_gaussian", BOX),
    "index": ("categorical", Categorical(3, shape=(4,))),
    "column of indices": (
        "categorical",
        Composite(action=Categorical(3, shape=(4, 1)), shape=(4,)),
    ),
    "one_hot": ("categorical", OneHot(3, shape=(4, 3))),
    "several indices": ("categorical", MultiCategorical([3, 2], shape=(4, 2))),
    "several one_hot": ("categorical", MultiOneHot([3, 2], shape=(4, 5))),
    "flags": ("categorical", Binary(2, shape=(4, 2), dtype=torch.bool)),
    "mixed": ("tanh_gaussian", MIXED),
}


def _actor(name, **options):
    distribution, spec = SPECS[name]
    return make_actor(
        ActorCfg(hidden_dims=(16,), distribution=distribution, **options),
        obs_dim=5,
        action_spec=spec,
    )


def _data():
    return TensorDict({"actor": torch.randn(4, 5)}, [4])


@pytest.mark.parametrize("name", SPECS)
def test_actions_are_of_the_spec_and_scored_by_the_distribution(name):
    actor, (_, spec) = _actor(name), SPECS[name]
    spec = spec if isinstance(spec, Composite) else Composite(action=spec, shape=(4,))
    data = actor(_data())
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        deterministic = [actor(_data()) for _ in range(2)]
    for out in (data, *deterministic):
        assert spec.is_in(out.select(*spec.keys(True, True)))
    dist = actor.get_dist(data.clone())
    if name == "mixed":
        assert isinstance(dist, CompositeDistribution)
        expected = dist.log_prob(data.select("action"))
        for part in ("arm", "grip"):
            key = ("action", f"{part}_log_prob")
            torch.testing.assert_close(data[key], expected[key])
            assert data[key].shape == (4,)
    else:
        torch.testing.assert_close(data["action_log_prob"], dist.log_prob(data["action"]))
        assert data["action_log_prob"].shape == (4,)


@pytest.mark.parametrize("name", ["tanh_gaussian", "truncated_gaussian"])
@pytest.mark.parametrize(
    "options", [{}, {"state_dependent_std": True}, {"std_type": "log"}], ids=str
)
def test_bounded_policies_start_at_the_center_with_init_std_of_half_the_range(name, options):
    torch.manual_seed(0)
    actor = _actor(name, init_std=0.1, **options)
    data = _data().expand(5000, 4).clone()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        center = actor(data.clone())["action"]
    torch.testing.assert_close(center, ((LOW + HIGH) / 2).expand(5000, 4, 2), atol=0.1, rtol=0.0)
    spread = (actor(data)["action"] - center).std((0, 1))
    torch.testing.assert_close(spread, 0.1 * (HIGH - LOW) / 2, atol=0.0, rtol=0.03)


def test_a_bound_of_our_own_where_the_spec_has_none():
    cfg = ActorCfg(hidden_dims=(), distribution="tanh_gaussian", action_bound=0.5, init_std=3.0)
    actions = make_actor(cfg, obs_dim=5, action_dim=2)(_data())["action"]
    assert actions.abs().max() <= 0.5
    bounded = make_actor(cfg, obs_dim=5, action_spec=BOX)
    assert torch.equal(bounded.module[0].module.head.high, HIGH), (
        "the bounds of the spec come first"
    )


@pytest.mark.parametrize("name", ["tanh_gaussian", "truncated_gaussian", "mixed"])
def test_bounds_follow_the_module_and_are_no_part_of_a_checkpoint(name):
    actor = _actor(name)
    double = copy.deepcopy(actor).double()
    data = double(TensorDict({"actor": torch.randn(4, 5, dtype=torch.float64)}, [4]))
    action = data["action", "arm"] if name == "mixed" else data["action"]
    assert action.dtype == torch.float64
    assert not any("low" in key or "high" in key for key in actor.state_dict())
    assert actor(_data())["action"].dtype != torch.float64


@pytest.mark.parametrize("name", SPECS)
def test_no_host_sync(name):
    actor, data = _actor(name), _data()
    with count_syncs() as syncs:
        actor(data)
    assert syncs.total == 0, syncs.report()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("tanh_gaussian", marks=pytest.mark.full),
        pytest.param("truncated_gaussian", marks=pytest.mark.full),
        pytest.param("several one_hot", marks=pytest.mark.full),
        "mixed",
    ],
)
def test_compiles_without_a_break(name):
    actor, data = _actor(name), _data()
    compiled = torch.compile(actor, fullgraph=True, backend="aot_eager")
    with torch.no_grad():
        sampled = compiled(data.clone())
        assert set(sampled.keys(True, True)) == set(actor(data.clone()).keys(True, True))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            one, other = compiled(data.clone()), actor(data.clone())
    for key in other.keys(True, True):
        torch.testing.assert_close(one[key], other[key])


@pytest.mark.parametrize(
    ("distribution", "spec", "message"),
    [
        ("categorical", BOX, "'categorical' does not go with the action 'action', Bounded"),
        (
            "gaussian",
            SPECS["index"][1],
            "'gaussian', but the action 'action' is discrete: use 'categorical'",
        ),
        (
            "tanh_gaussian",
            Unbounded((4, 2)),
            "needs bounds, but the action 'action' has no finite ones.*action_bound",
        ),
        ("truncated_gaussian", Bounded(-1.0, torch.inf, (4, 2)), "has no finite ones"),
        ("categorical", MIXED, r"\('action', 'arm'\), BoundedContinuous of float32"),
        ("gaussian", Bounded(0, 5, (4, 2), dtype=torch.int64), "BoundedDiscrete of int64"),
        (
            "gaussian",
            Composite(action=Unbounded((4, 2, 3)), shape=(4,)),
            r"shape \(2, 3\): expected one dim",
        ),
    ],
)
def test_a_distribution_that_does_not_go_with_the_spec_is_refused(distribution, spec, message):
    with pytest.raises(ValueError, match=message):
        make_actor(ActorCfg(distribution=distribution), obs_dim=5, action_spec=spec)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distribution": "gausian"}, "distribution='gausian'.*'gaussian'"),
        ({"action_bound": 1.0}, "action_bound=1.0 does nothing with distribution='gaussian'"),
        ({"distribution": "tanh_gaussian", "action_bound": -1.0}, "action_bound=-1.0"),
        ({"in_keys": ()}, r"in_keys=\(\)"),
        ({"in_keys": "actor"}, "in_keys='actor'"),
        ({"in_keys": ("actor", ("obs", 3))}, r"in_keys\[1\]=\('obs', 3\)"),
        ({"in_keys": ("actor", ["actor"])}, "each key can be read once"),
    ],
)
def test_config_refusals_name_the_field(options, message):
    with pytest.raises(ValueError, match=message):
        ActorCfg(**options)


def test_several_groups_are_read_side_by_side_and_normalized_as_one():
    actor = make_actor(
        ActorCfg(in_keys=("actor", ("obs", "height")), hidden_dims=(8,), output_gain=1.0),
        obs_dim=5,
        action_dim=2,
    )
    parts = torch.randn(40, 3) + 2.0, torch.randn(40, 2) * 3.0
    data = TensorDict({"actor": parts[0], "obs": {"height": parts[1]}}, [40])
    modules.update_normalizers(data, actor)
    network = actor.module[0].module
    torch.testing.assert_close(network.normalizer.mean, torch.cat(parts, -1).mean(0))
    loc, _ = network(torch.cat(parts, -1))
    torch.testing.assert_close(actor(data)["loc"], loc)
