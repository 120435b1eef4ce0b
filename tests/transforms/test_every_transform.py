"""What each transform has to pass, in our env and in TorchRL's, with batch size [E] and []."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import GymEnv, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv, check_env, count_syncs
from ksim_rl.transforms import KeyedTransform, ObservationGroups, ObservationNoise
from tests.transforms.chains import VECTOR, actions, assert_same, copied, fixed_rollout, seed_all
from tests.transforms.portable import PORTABLE, UNIFORM, exported_transforms
from tests.transforms.transform_checks import KINDS, has_episodes, masked, seen

every_kind = pytest.mark.parametrize("kind", KINDS)
every_class = pytest.mark.parametrize("name", PORTABLE)


def test_no_transform_is_left_out():
    # Pictures are no three numbers: `test_pictures` has their own checks.
    assert set(PORTABLE) == exported_transforms() - {"PictureEffects"}
    assert {type(build()).__name__ for build in KINDS.values()} == exported_transforms()


@every_kind
@pytest.mark.parametrize("lengths", [(3, 5, 4), ()])
def test_specs_in_a_stock_env(kind, lengths):
    check_env_specs(TransformedEnv(seen(lengths), KINDS[kind]()))


@every_kind
def test_specs_names_and_bounds_in_our_env(kind):
    # The rows of an env share the statistics of normalization.
    skip = ("memory", "partial_reset") if kind == "normalization" else ("memory",)
    check_env(masked(kind), num_steps=6, skip=skip)


@every_kind
def test_serial_env_inside_and_outside(kind):
    inside = SerialEnv(2, lambda: TransformedEnv(seen(()), KINDS[kind]()))
    check_env_specs(inside)
    inside.close()
    outside = TransformedEnv(SerialEnv(2, lambda: seen(())), KINDS[kind]())
    check_env_specs(outside)
    outside.close()


@every_kind
def test_specs_made_before_or_after_the_first_reset(kind):
    before, after = (TransformedEnv(seen((3, 5, 4)), Compose(KINDS[kind]())) for _ in range(2))
    assert before.output_spec is not None and before.input_spec is not None
    before.set_seed(0), after.set_seed(0)
    assert_same(before.reset(), after.reset())


@every_kind
def test_no_host_sync(kind):
    env = masked(kind)
    root = env.reset()
    steps = iter(actions(5, env))
    key = env.action_key
    with count_syncs() as syncs:
        root = env.reset()
        for _ in range(5):
            _, root = env.step_and_maybe_reset(root.set(key, next(steps)))
    assert syncs.total == 0, syncs.report()


@every_kind
def test_next_is_the_next_root_where_the_episode_goes_on(kind):
    env = masked(kind)
    steps = iter(actions(12, env))
    key = env.action_key
    rollout_ET = env.rollout(12, lambda td: td.set(key, next(steps)), break_when_any_done=False)
    goes_on = ~rollout_ET["next", "done"][:, :-1, 0]
    assert bool((~goes_on).any())
    for name in env.observation_spec.keys(True, True):
        reached, root = rollout_ET["next"][name][:, :-1], rollout_ET[name][:, 1:]
        assert torch.equal(reached[goes_on], root[goes_on]), name


@every_kind
def test_state_dict_continues_bit_exactly(kind):
    def run(env, root, num_steps):
        steps = iter(actions(num_steps, env))
        key = env.action_key
        return env.rollout(
            num_steps,
            lambda td: td.set(key, next(steps)),
            break_when_any_done=False,
            auto_reset=False,
            tensordict=root,
        )

    env, resumed = masked(kind), MaskedTransformedEnv(seen((3, 5, 4)), [KINDS[kind]()])
    run(env, env.reset(), 7)
    state = env.state_dict()
    root = env.maybe_reset(copied(env.last_root.exclude("reward", *env.reward_keys)))
    start = copied(root)
    ahead = run(env, root, 9)
    resumed.load_state_dict(state)
    again = resumed.maybe_reset(copied(resumed.last_root))
    assert_same(again, start)
    assert_same(run(resumed, again, 9), ahead)


@pytest.mark.parametrize("kind", sorted(KINDS.keys() - {"normalization"}))
def test_other_rows_do_not_notice_a_reset(kind):
    env, untouched = masked(kind), masked(kind)
    key = env.action_key
    roots = [env.reset(), untouched.reset()]
    steps = actions(8, env)
    for step in range(8):
        if step in (2, 3, 5):
            roots[0] = env.reset(env_ids=[1])
        roots = [
            e.step_and_maybe_reset(root.set(key, steps[step].clone()))[1]
            for e, root in zip((env, untouched), roots, strict=True)
        ]
        assert_same(roots[0], roots[1], rows=[0, 2])


@every_kind
def test_a_missing_key_is_named(kind):
    transform = KINDS[kind]()
    if not transform.in_keys and not transform.in_keys_inv:
        return
    if transform.in_keys:
        transform._in_keys = ["cuont", *transform.in_keys[1:]]
    else:
        transform._in_keys_inv = ["cuont"]
    if isinstance(transform, ObservationGroups):
        transform.groups = {"actor": ["cuont"]}
    env = TransformedEnv(CounterEnv(), transform)
    with pytest.raises(KeyError, match="'cuont'.*(did you mean|valid)"):
        env.output_spec, env.input_spec  # noqa: B018


@pytest.mark.parametrize(
    "name", ["ObservationClip", "ObservationScale", "ObservationNoise", "ObservationNormalization"]
)
def test_whole_numbers_are_refused_and_other_precisions_kept(name):
    spec = CounterEnv().observation_spec.clone()
    spec["whole"] = Unbounded((3, 3), dtype=torch.int64)
    with pytest.raises(ValueError, match="'whole' is torch.int64"):
        PORTABLE[name]("whole").transform_observation_spec(spec)
    for dtype in (torch.float16, torch.float64):
        batch = TensorDict({"x": torch.ones(8, 3, dtype=dtype)}, batch_size=8)
        transform = with_statistics(PORTABLE[name]("x"))
        assert transform(batch)[transform.out_keys[0]].dtype == dtype


@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.full)])
@every_class
def test_it_compiles_without_a_graph_break(name, backend):
    """What the transform does in a step and in a reset; `test_masked_transformed_env` compiles a whole env."""
    env = MaskedTransformedEnv(CounterEnv((3, 5, 4, 2), action_size=1), [PORTABLE[name](VECTOR)])
    transform = env.transform[0]
    root = env.rand_action(env.reset())
    reached = env.base_env.step(root.clone())["next"]

    def step(action):
        sent = transform.inv(TensorDict({"action": action}, batch_size=4))
        stepped = transform._step(sent, reached.clone(False))
        reset = TensorDict({"_reset": reached["done"]}, batch_size=4)
        return sent, stepped, transform._reset(reset, reached.clone(False))

    state = {key: value.clone() for key, value in transform.state_dict().items()}
    expected = step(root["action"])
    transform.load_state_dict(state)
    found = torch.compile(step, fullgraph=True, backend=backend)(root["action"])
    for ours, theirs in zip(found, expected, strict=True):
        for key, value in theirs.items(True, True):
            torch.testing.assert_close(ours[key], value)


@every_kind
def test_state_keeps_its_addresses(kind):
    """A captured step reads and writes the memory that it was captured with."""
    env = masked(kind)
    env.reset()
    before = {name: buffer.data_ptr() for name, buffer in env.transform.named_buffers()}
    env.rollout(6, break_when_any_done=False)
    env.reset(env_ids=[1])
    assert {name: buffer.data_ptr() for name, buffer in env.transform.named_buffers()} == before


@every_class
def test_a_gym_env(name):
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(PORTABLE[name]("observation")))
    check_env_specs(env)
    rollout_T = env.rollout(6)
    for key, spec in env.full_observation_spec.items(True, True):
        values = rollout_T["next", key] if isinstance(key, str) else rollout_T[("next", *key)]
        assert all(spec.is_in(value) for value in values), key
    assert env.full_reward_spec.is_in(rollout_T["next"].select(*env.reward_keys)[3])
    env.close()


# Each takes seconds, as its processes start: one per kind of transform here, all in the full tests.
@pytest.mark.parametrize(
    "name",
    [n if n == "ActionLowPass" else pytest.param(n, marks=pytest.mark.full) for n in PORTABLE],
)
def test_parallel_env_inside_and_outside(name):
    inside = ParallelEnv(
        2,
        lambda: TransformedEnv(CounterEnv((), action_size=1), PORTABLE[name](VECTOR)),
        mp_start_method="fork",
    )
    outside = TransformedEnv(
        ParallelEnv(2, lambda: CounterEnv((), action_size=1), mp_start_method="fork"),
        PORTABLE[name](VECTOR),
    )
    for env in (inside, outside):
        try:
            check_env_specs(env)
        finally:
            env.close()


def samples() -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {
            "x": torch.randn(8, 3, generator=generator),
            "action": torch.randn(8, 1, generator=generator),
            "reward": torch.randn(8, 1, generator=generator),
        },
        batch_size=8,
    )


def with_statistics(transform):
    """Give a normalization the statistics that an env would, and noise a seed."""
    if isinstance(transform, KeyedTransform):
        transform.seed_(0)
    if hasattr(transform, "moments"):
        transform._size_moments([3], None)
        transform.moments[0].update(torch.randn(100, 3) + 1)
    return transform


@every_class
@pytest.mark.parametrize("where", ["alone", "compose", "model", "replay buffer"])
def test_a_batch_of_samples(name, where):
    """Those that follow episodes refuse; the others do there what they do in an env, and nothing else."""
    transform = with_statistics(PORTABLE[name]("x"))
    alone = with_statistics(PORTABLE[name]("x"))
    if hasattr(transform, "moments"):
        alone.load_state_dict(transform.state_dict())

    def run():
        if where == "replay buffer":
            buffer = ReplayBuffer(storage=LazyTensorStorage(8), batch_size=8)
            buffer.extend(samples())
            buffer.append_transform(transform)
            return buffer.sample()
        if where == "model":
            reads = transform.out_keys[0] if transform.out_keys else "x"
            size = 1 if reads == "reward" else 3
            module = TensorDictModule(torch.nn.Linear(size, 2), in_keys=[reads], out_keys=["y"])
            return torch.nn.Sequential(transform, module)(samples())
        return (Compose(transform) if where == "compose" else transform)(samples())

    if has_episodes(transform):
        with pytest.raises(RuntimeError, match="state per env"):
            run()
        return
    found = run()
    assert found.batch_size == (8,)
    if where == "model":
        assert found["y"].shape == (8, 2)
    elif where == "compose":
        expected = alone(samples())
        assert_same(found, expected)
        changed = [key for key, value in samples().items() if not torch.equal(found[key], value)]
        assert set(changed) <= set(transform.out_keys), changed


@every_class
def test_the_inverse_of_a_batch(name):
    transform = PORTABLE[name]("x")
    if not transform.in_keys_inv:
        assert_same(transform.inv(samples()), samples())
    elif name == "ActionClip":
        assert torch.equal(transform.inv(samples())["action"], samples()["action"].clamp(-1, 1))
    else:
        with pytest.raises(RuntimeError, match="env"):
            transform.inv(samples())


@pytest.mark.parametrize("seed", [0, 1])
def test_two_transforms_of_one_kind_draw_apart(seed):
    env = MaskedTransformedEnv(
        CounterEnv((3, 5, 4)),
        [
            ObservationNoise("count", "a", noise=UNIFORM),
            ObservationNoise("count", "b", noise=UNIFORM),
            ObservationNoise("count", "c", noise=UNIFORM, stream="mine"),
            ObservationNoise("count", "d", noise=UNIFORM, stream="mine"),
        ],
    )
    seed_all(env, seed)
    rollout_ET = fixed_rollout(env, 10)
    assert not (rollout_ET["a"] == rollout_ET["b"]).any()
    assert torch.equal(rollout_ET["c"], rollout_ET["d"])


def test_two_of_one_kind_and_key_draw_apart_however_the_chain_came_about():
    def drawn_ET(num_transforms, *, appended=0, in_front=0):
        noises = [ObservationNoise("count", noise=UNIFORM) for _ in range(num_transforms)]
        env = MaskedTransformedEnv(
            CounterEnv((3, 5, 4)), noises[in_front : num_transforms - appended]
        )
        for noise in noises[num_transforms - appended :]:
            assert env.output_spec is not None
            env.append_transform(noise)
        for noise in noises[:in_front]:
            assert env.output_spec is not None
            env.insert_transform(0, noise)
        seed_all(env, 3)
        return fixed_rollout(env, 10)["count"] - fixed_rollout(CounterEnv((3, 5, 4)), 10)["count"]

    first_ET, both_ET = drawn_ET(1), drawn_ET(2)
    assert not torch.isclose(both_ET, 2.0 * first_ET).any()
    torch.testing.assert_close(drawn_ET(2, appended=1), both_ET)
    torch.testing.assert_close(drawn_ET(2, in_front=1), both_ET)
