import pytest
import torch
from tensordict import TensorDict
from torch.torch_version import TorchVersion
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose, RewardSum, StepCounter
from torchrl.envs.utils import check_env_specs

from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv, assert_dims, check_env, count_syncs
from ksim_rl.transforms import GaussianNoise, ObservationNoise
from ksim_rl.transforms.row_transform import KeyedTransform, held_transforms
from tests.transforms.chains import (
    actions,
    assert_same,
    copied,
    counter,
    fixed_rollout,
    full_chain,
    seed_all,
)


class MaskedCounterEnv(MaskedReset, CounterEnv):
    """The counter env with masked resets of its own, without any transform."""


def fresh(stock: bool = False, lengths=(3, 5, 4, 7)) -> TransformedEnv:
    env = counter(*full_chain(), lengths=lengths, stock=stock)
    seed_all(env, 3)
    return env


def test_trajectories_equal_stock_torchrl():
    ours, theirs = fixed_rollout(fresh(), 25), fixed_rollout(fresh(stock=True), 25)
    assert ours.names == ["E", "T"]
    assert int(ours["next", "done"].sum()) > 10
    assert_same(ours, theirs)


def test_trajectories_equal_stock_torchrl_with_stock_transforms():
    chain = lambda: Compose(*full_chain(), StepCounter(max_steps=6), RewardSum())  # noqa: E731
    envs = [
        MaskedTransformedEnv(CounterEnv((3, 8, 4)), chain()),
        TransformedEnv(CounterEnv((3, 8, 4)), chain()),
    ]
    for env in envs:
        check_env_specs(env)
        seed_all(env, 1)
    assert_same(*(fixed_rollout(env, 20) for env in envs))


def test_a_bare_masked_env_equals_a_stock_env():
    ours, theirs = MaskedCounterEnv((3, 5, 4)), CounterEnv((3, 5, 4))
    check_env(ours)
    for env in (ours, theirs):
        env.set_seed(5)
    assert_same(fixed_rollout(ours, 12), fixed_rollout(theirs, 12))


def test_a_stock_transformed_env_around_ours_is_right():
    around_transformed = TransformedEnv(fresh(), StepCounter(), auto_unwrap=False)
    around_bare = TransformedEnv(
        MaskedCounterEnv((3, 5, 4, 7)), Compose(*full_chain(), StepCounter())
    )
    plain = TransformedEnv(CounterEnv((3, 5, 4, 7)), Compose(*full_chain(), StepCounter()))
    for env in (around_transformed, around_bare, plain):
        check_env_specs(env)
        seed_all(env, 3)
        seed_all(env.base_env, 3) if isinstance(env.base_env, TransformedEnv) else None
    expected = fixed_rollout(plain, 15)
    assert_same(fixed_rollout(around_bare, 15), expected)
    assert_same(fixed_rollout(around_transformed, 15), expected)


def test_the_stock_collector_works_on_it():
    env = fresh()
    collector = Collector(env, None, frames_per_batch=40, total_frames=80)
    batches = list(collector)
    collector.shutdown()
    assert len(batches) == 2
    count, done = batches[0]["next", "count"], batches[0]["next", "done"]
    lengths = torch.tensor([3.0, 5.0, 4.0, 7.0])[:, None, None].expand_as(count)
    assert torch.equal(done, count >= lengths)


def test_no_host_sync_in_steps_resets_and_rollouts():
    env = fresh()
    root = env.reset()
    chosen = actions(6, env)
    mask = torch.tensor([True, False, True, False])
    with count_syncs() as syncs:
        root = env.reset()
        for action in chosen:
            _, root = env.step_and_maybe_reset(root.set("action", action))
        env.reset(TensorDict({"_reset": mask}, batch_size=4))
        steps = iter(chosen)
        env.rollout(6, lambda td: td.set("action", next(steps)), break_when_any_done=False)
    assert syncs.total == 0, syncs.report()


def test_stock_transformed_env_does_sync():
    env = fresh(stock=True)
    root, action = env.reset(), actions(1, env)[0]
    with count_syncs() as syncs:
        env.step_and_maybe_reset(root.set("action", action))
    assert syncs.total > 0


def test_names_on_specs_and_data():
    env = fresh()
    check_env(env)
    assert_dims(env.reset(env_ids=[0]), "E")
    assert env.full_observation_spec["obs"].names == ["E"]


@pytest.mark.parametrize("how", ["env_ids", "tensor", "mask_E", "mask_E1", "mask_and_root"])
def test_a_partial_reset_leaves_the_other_rows_alone(how):
    env, untouched = fresh(), fresh()
    for other in (env, untouched):
        root = other.reset()
        for action in actions(2, other):
            _, root = other.step_and_maybe_reset(root.set("action", action))
    before = copied(root.exclude("action", "reward"))
    mask = torch.tensor([False, True, False, True])
    given = {
        "env_ids": lambda: {"env_ids": [3, 1]},
        "tensor": lambda: {"env_ids": torch.tensor([1, 3])},
        "mask_E": lambda: {"tensordict": TensorDict({"_reset": mask}, batch_size=4)},
        "mask_E1": lambda: {"tensordict": TensorDict({"_reset": mask[:, None]}, batch_size=4)},
        "mask_and_root": lambda: {"tensordict": copied(before).set("_reset", mask[:, None])},
    }[how]()
    result = env.reset(**given)
    assert "_reset" not in result
    assert_same(result.select(*before.keys(True, True)), before, rows=[0, 2])
    assert result["count"].flatten().tolist() == [2.0, 0.0, 2.0, 0.0]
    # The rows that went on continue as if nothing had happened: histories, delays, biases and draws included.
    ahead = fixed_rollout(env, 10, result)
    expected = fixed_rollout(untouched, 10, before.clone())
    assert_same(ahead, expected, rows=[0, 2])


def test_a_partial_reset_between_step_and_maybe_reset_returns_the_state_reached():
    env = fresh()
    stepped = env.step(env.reset().set("action", actions(1, env)[0]))
    reached = copied(stepped["next"].exclude("reward"))
    assert_same(env.reset(env_ids=[0]), reached, rows=[1, 2, 3])


def test_an_empty_partial_reset_returns_the_last_root():
    env = fresh()
    root = copied(env.reset())
    assert_same(env.reset(env_ids=[]), root)


def test_a_partial_reset_needs_a_root():
    with pytest.raises(RuntimeError, match="call reset"):
        fresh().reset(env_ids=[0])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"env_ids": [4]}, ValueError, "valid rows are 0 to 3"),
        ({"env_ids": [-1]}, ValueError, "valid rows are 0 to 3"),
        ({"env_ids": [1, 1]}, ValueError, "more than once"),
        ({"env_ids": [0.5]}, ValueError, "integers"),
        ({"env_ids": torch.tensor([True, False, False, False])}, ValueError, "_reset"),
        ({"env_id": [1]}, TypeError, "did you mean 'env_ids'"),
        ({"options": {"a": 1}}, ValueError, "no reset options"),
        (
            {"tensordict": TensorDict({"_reset": torch.ones(3, dtype=torch.bool)}, [])},
            ValueError,
            "_reset",
        ),
        ({"tensordict": TensorDict({"_reset": torch.ones(4)}, [4])}, ValueError, "torch.bool"),
        (
            {
                "env_ids": [0],
                "tensordict": TensorDict({"_reset": torch.ones(4, dtype=torch.bool)}, [4]),
            },
            ValueError,
            "both",
        ),
    ],
)
def test_reset_refuses_what_it_does_not_know(arguments, error, message):
    env = fresh()
    env.reset()
    with pytest.raises(error, match=message):
        env.reset(**arguments)


def test_torchrl_keywords_are_passed_on():
    env = fresh()
    assert env.reset(set_state=False, select_reset_only=True, options={})["count"].sum() == 0


def test_a_full_reset_updates_the_given_tensordict():
    env = fresh()
    given = TensorDict({"mine": torch.ones(4)}, batch_size=4)
    assert env.reset(given) is given
    assert "mine" in given and "actor" in given


def test_seeds_reach_env_and_transforms():
    env = fresh()
    following = env.set_seed(11)
    first = copied(env.reset())
    env.reset()
    assert env.seed(11) == 11
    assert_same(env.reset(), first)
    assert_same(env.reset(seed=11), first)
    assert following == CounterEnv().set_seed(11) != 11
    assert not torch.equal(env.reset(seed=12)["actor"], first["actor"])
    drawn = env.seed()
    assert drawn >= 0
    assert {int(transform.seed_value) for transform in held_transforms(env, KeyedTransform)} == {
        drawn
    }


def test_a_state_dict_continues_bit_exactly():
    env = fresh()
    root = fixed_rollout(env, 9)[:, -1]["next"].exclude("reward")
    root = env.maybe_reset(root)
    state = {key: value.clone() for key, value in env.state_dict().items()}
    start = copied(root)
    expected = fixed_rollout(env, 12, copied(start))
    for resumed in (fresh(), counter(*full_chain(), lengths=(3, 5, 4, 7))):
        resumed.load_state_dict(state)
        assert_same(resumed.last_root, start)
        assert_same(fixed_rollout(resumed, 12, copied(start)), expected)


def test_a_state_dict_of_another_kind_is_refused():
    with pytest.raises(KeyError, match="base_env."):
        fresh().load_state_dict({"what": torch.ones(1)})


@pytest.mark.full
@pytest.mark.skipif(
    TorchVersion(torch.__version__) < "2.13",
    reason="Dynamo of torch 2.10 cannot trace TorchRL's cache of specs",
)
def test_it_compiles_without_a_graph_break():
    # The graph is what this is about: no code is generated, which would take minutes.
    eager, compiled = fresh(), fresh()
    compiled.compile(fullgraph=True, backend="eager")
    roots = [eager.reset(), compiled.reset()]
    for action in actions(8, eager):
        roots = [
            env.step_and_maybe_reset(root.set("action", action.clone()))[1]
            for env, root in zip((eager, compiled), roots, strict=True)
        ]
        for key, value in roots[0].items(True, True):
            torch.testing.assert_close(roots[1][key], value)
    after = [env.reset(env_ids=[1]) for env in (eager, compiled)]
    torch.testing.assert_close(after[1]["actor"], after[0]["actor"])


def test_envs_that_cannot_be_asked_to_reset_nothing_keep_torchrls_reset():
    single = counter(ObservationNoise("count", noise=GaussianNoise(std=1.0)), lengths=())
    assert single.rollout(7, break_when_any_done=False)["next", "done"].flatten().tolist() == [
        False, False, True, False, False, True, False,
    ]  # fmt: skip
    serial = MaskedTransformedEnv(SerialEnv(2, lambda: CounterEnv(())), Compose(*full_chain()))
    assert serial.rollout(7, break_when_any_done=False).names == ["E", "T"]
    serial.reset(env_ids=[1])
    serial.close()


def test_a_copy_of_a_transform_has_state_of_its_own():
    env = fresh()
    env.reset()
    noise = env.transform[1]
    before = noise.bias_EL.clone()
    assert isinstance(noise.parent, EnvBase)
    noise.clone().bias_EL.zero_()
    env.transform[-1].parent.reset()
    assert torch.equal(noise.bias_EL, before)
