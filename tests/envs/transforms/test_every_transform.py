"""What each transform has to pass, in our env and in TorchRL's, with batch size [E] and []."""

import pytest
import torch
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.envs.transforms import (
    ActionDelay,
    ConstantNoise,
    DelayCfg,
    GaussianNoise,
    ObservationClip,
    ObservationDelay,
    ObservationGroups,
    ObservationHistory,
    ObservationNoise,
    ObservationScale,
    UniformNoise,
)
from ksim_rl.testing import CounterEnv, check_env, count_syncs
from tests.envs.transforms.chains import VECTOR, actions, assert_same, copied, fixed_rollout, seed_all

NEW = ("other", "deeply", "vector")
UNIFORM = UniformNoise(low=-1.0, high=1.0)
KINDS = {
    "uniform": lambda: ObservationNoise("count", noise=UNIFORM),
    "gaussian": lambda: ObservationNoise(VECTOR, NEW, noise=GaussianNoise(std=(1.0, 2.0, 3.0))),
    "biased": lambda: ObservationNoise([VECTOR], noise=GaussianNoise(std=0.1, bias=UNIFORM)),
    "mixed": lambda: ObservationNoise(
        ["count", VECTOR, "row"],
        noise=[UNIFORM, GaussianNoise(std=1.0, operation="multiply"), ConstantNoise(value=2.0, bias=UNIFORM)],
    ),
    "clip": lambda: ObservationClip(
        [VECTOR, "count"], [NEW, "count"], clip={VECTOR: (None, 150.0), "count": (1.0, 2.0)}
    ),
    "scale": lambda: ObservationScale([VECTOR, "count"], scale={VECTOR: (1.0, 0.0, -2.0), "count": 3.0}),
    "delay": lambda: ObservationDelay(VECTOR, NEW, delay=DelayCfg(max_lag=3)),
    "delay_resampled": lambda: ObservationDelay(
        [VECTOR, "count"], delay=DelayCfg(max_lag=3, resample_every=2, hold_probability=0.5)
    ),
    "delay_shared": lambda: ObservationDelay("drawn", delay=DelayCfg(max_lag=3, per_env=False, resample_every=2)),
    "history": lambda: ObservationHistory([VECTOR, "drawn"], [NEW, "drawn"], length=4),
    "history_stacked": lambda: ObservationHistory([VECTOR, "drawn"], length=4, flat=False),
    "groups": lambda: ObservationGroups({"actor": [VECTOR, "count"], ("my", "critic"): ["drawn"]}, drop=[VECTOR]),
    "groups_drop_all": lambda: ObservationGroups({"actor": [VECTOR, "count"]}, drop=True),
    "action_delay": lambda: ActionDelay(delay=DelayCfg(max_lag=2, resample_every=3)),
    "action_delay_renamed": lambda: ActionDelay("action", "wish", delay=DelayCfg(min_lag=1, max_lag=1)),
}  # fmt: skip

every_kind = pytest.mark.parametrize("kind", KINDS)


def masked(kind: str) -> MaskedTransformedEnv:
    env = MaskedTransformedEnv(CounterEnv((3, 5, 4)), [KINDS[kind]()])
    env.set_seed(1)
    return env


@every_kind
@pytest.mark.parametrize("lengths", [(3, 5, 4), ()])
def test_specs_in_a_stock_env(kind, lengths):
    check_env_specs(TransformedEnv(CounterEnv(lengths), KINDS[kind]()))


@every_kind
def test_specs_names_and_bounds_in_our_env(kind):
    check_env(masked(kind), num_steps=6)


@every_kind
def test_serial_env_inside_and_outside(kind):
    inside = SerialEnv(2, lambda: TransformedEnv(CounterEnv(()), KINDS[kind]()))
    check_env_specs(inside)
    inside.close()
    outside = TransformedEnv(SerialEnv(2, lambda: CounterEnv(())), KINDS[kind]())
    check_env_specs(outside)
    outside.close()


@every_kind
def test_specs_made_before_or_after_the_first_reset(kind):
    before, after = (TransformedEnv(CounterEnv((3, 5, 4)), Compose(KINDS[kind]())) for _ in range(2))
    assert before.output_spec is not None and before.input_spec is not None
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

    env, resumed = masked(kind), MaskedTransformedEnv(CounterEnv((3, 5, 4)), [KINDS[kind]()])
    run(env, env.reset(), 7)
    state = env.state_dict()
    root = env.maybe_reset(copied(env.last_root.exclude("reward")))
    start = copied(root)
    ahead = run(env, root, 9)
    resumed.load_state_dict(state)
    again = resumed.maybe_reset(copied(resumed.last_root))
    assert_same(again, start)
    assert_same(run(resumed, again, 9), ahead)


@every_kind
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
    if kind.startswith("action"):
        with pytest.raises(KeyError, match="did you mean 'action'"):
            TransformedEnv(CounterEnv(), ActionDelay("acton", delay=DelayCfg(max_lag=1))).input_spec  # noqa: B018
        return
    transform = KINDS[kind]()
    transform._in_keys = ["cuont", *transform.in_keys[1:]]
    if isinstance(transform, ObservationGroups):
        transform.groups = {"actor": ["cuont"]}
    with pytest.raises(KeyError, match="did you mean 'count'"):
        transform.transform_observation_spec(CounterEnv().observation_spec.clone())


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
