import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose

from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    ConstantNoise,
    GaussianNoise,
    ObservationNoise,
    UniformNoise,
)
from tests.transforms.chains import VECTOR, counter, fixed_rollout

SAMPLES = 120_000


def added(noise, lengths=(50,) * 400, steps=100, key=VECTOR):
    """Return noisy minus clean, [E, T, L], with the steps' and the resets' own draws in it."""
    env = counter(ObservationNoise(key, "noisy", noise=noise), lengths=lengths)
    rollout_ET = fixed_rollout(env, steps)
    return rollout_ET, rollout_ET["noisy"] - rollout_ET[key]


def assert_moments(sample, mean, std):
    """Check mean and std within 4 standard errors, from at least 1e5 numbers."""
    n = sample.numel()
    assert n >= 100_000
    assert abs(sample.mean() - mean) < 4 * std / math.sqrt(n) + 1e-5
    # The variance of the sample std is below std^2 / n for both distributions (kurtosis at most 3: / 2n).
    assert abs(sample.std() - std) < 4 * std / math.sqrt(2 * n)


def test_uniform_moments_and_range():
    _, noise = added(UniformNoise(low=-1.0, high=3.0))
    assert_moments(noise, 1.0, 4 / math.sqrt(12))
    assert noise.min() >= -1.0001 and noise.max() <= 3.0001


def test_gaussian_moments():
    _, noise = added(GaussianNoise(std=0.5, mean=2.0))
    assert_moments(noise, 2.0, 0.5)


def test_reset_observations_are_noisy_too():
    rollout_ET, noise = added(GaussianNoise(std=1.0), lengths=(1,) * 500, steps=100)
    at_reset = noise[rollout_ET["count"][..., 0] == 0]
    assert at_reset.shape[0] == 50_000
    assert_moments(at_reset, 0.0, 1.0)


def test_per_dim_parameters():
    _, noise = added(
        GaussianNoise(std=(0.0, 1.0, 2.0), mean=(5.0, 0.0, -1.0)), lengths=(50,) * 1100
    )
    assert bool((noise[..., 0] - 5.0).abs().max() < 1e-4)
    assert_moments(noise[..., 1], 0.0, 1.0)
    assert_moments(noise[..., 2], -1.0, 2.0)


def test_draws_are_independent_over_envs_steps_and_dims():
    _, noise = added(GaussianNoise(std=1.0))
    for a, b in [
        (noise[:-1], noise[1:]),
        (noise[:, :-1], noise[:, 1:]),
        (noise[..., :-1], noise[..., 1:]),
        (noise[:, 50:], noise[:, :50]),
    ]:
        assert abs((a * b).mean()) < 4 / math.sqrt(a.numel())


def test_constant_and_multiplicative():
    env = counter(
        ObservationNoise("count", "plus", noise=ConstantNoise(value=2.0)),
        ObservationNoise("count", "times", noise=ConstantNoise(value=2.0, operation="multiply")),
        ObservationNoise(
            "row", "random", noise=UniformNoise(low=0.5, high=1.5, operation="multiply")
        ),
    )
    rollout_ET = fixed_rollout(env, 10)
    count = rollout_ET["count"]
    assert torch.equal(rollout_ET["plus"], count + 2)
    assert torch.equal(rollout_ET["times"], count * 2)
    factor = rollout_ET["random"][1:] / rollout_ET["row"][1:]
    assert bool((factor >= 0.5).all()) and bool((factor <= 1.5).all()) and factor.std() > 0.1
    assert torch.equal(rollout_ET["random"][0], rollout_ET["row"][0])


def test_mixed_kinds_in_one_transform_each_keep_their_distribution():
    noise = ObservationNoise(
        ["count", VECTOR, "row"],
        ["a", "b", "c"],
        noise={
            "count": ConstantNoise(value=1.0),
            VECTOR: GaussianNoise(std=1.0),
            "row": UniformNoise(low=0.0, high=1.0, operation="multiply"),
        },
    )
    env = counter(noise, lengths=(50,) * 1100)
    rollout_ET = fixed_rollout(env, 100)
    assert torch.equal(rollout_ET["a"], rollout_ET["count"] + 1)
    assert_moments(rollout_ET["b"] - rollout_ET[VECTOR], 0.0, 1.0)
    factor = (rollout_ET["c"] / rollout_ET["row"])[1:]
    assert_moments(factor, 0.5, 1 / math.sqrt(12))


def test_bias_is_constant_in_an_episode_and_independent_across_episodes_and_envs():
    noise = ConstantNoise(value=0.0, bias=UniformNoise(low=-1.0, high=1.0))
    rollout_ET, bias = added(noise, lengths=(4,) * 1000, steps=140)
    per_episode = bias.reshape(1000, 35, 4, 3)
    assert bool((per_episode - per_episode[:, :, :1]).abs().max() < 1e-4)
    drawn = per_episode[:, :, 0]
    assert_moments(drawn, 0.0, 1 / math.sqrt(3))
    for a, b in [
        (drawn[:-1], drawn[1:]),
        (drawn[:, :-1], drawn[:, 1:]),
        (drawn[..., :-1], drawn[..., 1:]),
    ]:
        assert abs((a * b).mean()) < 4 / 3 / math.sqrt(a.numel())
    # The terminal observation still has the bias of the episode that ends there.
    reached = rollout_ET["next", "noisy"] - rollout_ET["next", VECTOR]
    assert bool((reached - bias).abs().max() < 1e-4)


def test_normal_noise_follows_the_normal_distribution():
    """Kolmogorov and Smirnov's distance to the closed form; 1.95 / sqrt(n) is exceeded once in a thousand times."""
    _, noise = added(GaussianNoise(std=2.0, mean=-1.0))
    sorted_N = ((noise.flatten() + 1.0) / 2.0).sort().values.double()
    steps = torch.arange(1, sorted_N.numel() + 1) / sorted_N.numel()
    distance = (torch.special.ndtr(sorted_N) - steps).abs().max()
    assert distance < 1.95 / math.sqrt(sorted_N.numel())
    assert abs((sorted_N**4).mean() - 3.0) < 4 * math.sqrt(96 / sorted_N.numel())


def test_walk_drifts_from_zero_and_begins_anew_at_each_reset():
    _, drift = added(ConstantNoise(walk_std=0.1), lengths=(25,) * 400, steps=100)
    per_episode = drift.reshape(1600, 25, 3)
    assert bool((per_episode[:, 0] == 0).all())
    steps = per_episode[:, 1:] - per_episode[:, :-1]
    assert_moments(steps, 0.0, 0.1)
    assert abs((steps[:, 1:] * steps[:, :-1]).mean()) < 4 * 0.01 / math.sqrt(steps[:, 1:].numel())
    # After k steps the variance is k std^2; a sample variance of n normals has the standard error sqrt(2 / n).
    last = per_episode[:, -1]
    assert abs(last.var() / (24 * 0.01) - 1) < 4 * math.sqrt(2 / last.numel())


def test_resolution_rounds_to_the_nearest_multiple():
    noise = UniformNoise(low=-1.0, high=1.0, resolution=(0.25, 0.0, 0.5))
    env = counter(ObservationNoise(VECTOR, "noisy", noise=noise), lengths=(50,) * 100)
    rollout_ET = fixed_rollout(env, 50)
    noisy = rollout_ET["noisy"]
    # Uniform numbers in [-1, 1) round to -1, ..., 1 with these variances, the ends half as often as the others.
    for column, step, variance in ((0, 0.25, 0.34375), (2, 0.5, 0.375)):
        multiples = noisy[..., column] / step
        assert torch.equal(multiples, multiples.round())
        error = noisy[..., column] - rollout_ET[VECTOR][..., column]
        assert abs(error.var() / variance - 1) < 4 * math.sqrt(2 / error.numel())
    assert not torch.equal(noisy[..., 1] * 4, (noisy[..., 1] * 4).round())


def test_lost_readings_are_the_last_ones_or_zero_and_are_lost_whole():
    probability = 0.3
    env = counter(
        ObservationNoise(VECTOR, "held", noise=ConstantNoise(value=1.0, dropout=probability)),
        ObservationNoise(
            VECTOR, "zeroed", noise=ConstantNoise(value=1.0, dropout=probability, lost="zero")
        ),
        lengths=(20,) * 900,
    )
    rollout_ET = fixed_rollout(env, 120)
    arrived = rollout_ET[VECTOR] + 1.0
    is_reset = rollout_ET["count"][..., 0] == 0
    zeroed = (rollout_ET["zeroed"] == 0).all(-1)
    assert torch.equal(rollout_ET["zeroed"][~zeroed], arrived[~zeroed]), (
        "a reading arrives whole or not at all"
    )
    assert not bool(zeroed[is_reset].any()), "the reading of a reset always arrives"
    share = zeroed[~is_reset].float()
    assert abs(share.mean() - probability) < 4 * math.sqrt(
        probability * (1 - probability) / share.numel()
    )
    held = rollout_ET["held"]
    lost = (held != arrived).any(-1)
    assert not bool(lost[is_reset].any())
    # Time runs along dim 1: what stands in for a lost reading is what was given out one step before.
    assert torch.equal(held[:, 1:][lost[:, 1:]], held[:, :-1][lost[:, 1:]])
    assert abs(lost[~is_reset].float().mean() - probability) < 0.01


def test_the_clean_reading_stays_beside_one_that_has_everything():
    noise = GaussianNoise(
        std=1.0, bias=UniformNoise(low=1.0, high=2.0), walk_std=0.1, resolution=0.1, dropout=0.2
    )
    env = counter(ObservationNoise(VECTOR, "noisy", noise=noise))
    plain = fixed_rollout(counter(), 12)
    rollout_ET = fixed_rollout(env, 12)
    assert torch.equal(rollout_ET[VECTOR], plain[VECTOR])
    assert (rollout_ET["noisy"] != rollout_ET[VECTOR]).float().mean() > 0.9
    env.eval()
    rollout_ET = fixed_rollout(env, 12)
    assert torch.equal(rollout_ET["noisy"], rollout_ET[VECTOR])


def test_bias_has_an_operation_of_its_own_and_comes_first():
    noise = ConstantNoise(value=1.0, bias=ConstantNoise(value=3.0, operation="multiply"))
    rollout_ET = fixed_rollout(counter(ObservationNoise("count", "noisy", noise=noise)), 6)
    assert torch.equal(rollout_ET["noisy"], rollout_ET["count"] * 3 + 1)


def test_eval_train_and_the_flag_switch_it():
    noise = ObservationNoise("count", "noisy", noise=UniformNoise(low=1.0, high=2.0))
    env = counter(noise)

    def is_noisy():
        rollout_ET = fixed_rollout(env, 4)
        noisy = bool((rollout_ET["noisy"] != rollout_ET["count"]).all())
        assert noisy or torch.equal(rollout_ET["noisy"], rollout_ET["count"])
        return noisy

    assert is_noisy(), "TorchRL calls eval() on what it attaches; that must not turn the noise off"
    env.eval()
    assert not is_noisy()
    env.train()
    assert is_noisy()
    noise.enable_(False)
    assert not is_noisy()
    env.train()
    assert not is_noisy()
    noise.enable_()
    assert is_noisy()


@pytest.mark.parametrize("attach", ["compose", "append", "insert", "single", "append_to_single"])
def test_attaching_in_any_way_leaves_it_on(attach):
    noise = ObservationNoise("count", "noisy", noise=UniformNoise(low=1.0, high=2.0))
    other = ObservationNoise("row", "noisy_row", noise=UniformNoise(low=1.0, high=2.0))
    if attach == "compose":
        env = TransformedEnv(CounterEnv(), Compose(noise))
    elif attach == "single":
        env = TransformedEnv(CounterEnv(), noise)
    elif attach == "append_to_single":
        env = TransformedEnv(CounterEnv(), noise).append_transform(other)
    elif attach == "append":
        env = TransformedEnv(CounterEnv(), Compose(other)).append_transform(noise)
    else:
        env = TransformedEnv(CounterEnv(), Compose(other)).insert_transform(0, noise)
    root = env.reset()
    assert bool((root["noisy"] >= 1).all())
    env.eval()
    assert torch.equal(env.reset()["noisy"], env.reset()["count"])


def test_evaluation_is_not_part_of_the_saved_state():
    env = counter(ObservationNoise("count", "noisy", noise=UniformNoise(low=1.0, high=2.0)))
    env.reset()
    state = env.state_dict()
    env.eval()
    env.load_state_dict(state)
    assert torch.equal(env.reset()["noisy"], torch.zeros(3, 1))


def test_noise_is_drawn_afresh_when_it_is_switched_on_again():
    """Switching off does not shift the draws: evaluation in between changes no number."""
    on, switched = (
        counter(ObservationNoise("count", "noisy", noise=UniformNoise(low=1.0, high=2.0)))
        for _ in "ab"
    )
    on.set_seed(0), switched.set_seed(0)
    expected = fixed_rollout(on, 6)
    root = switched.reset()
    switched.eval()
    for _ in range(2):
        _, root = switched.step_and_maybe_reset(root.set("action", torch.zeros(3, 2)))
    switched.train()
    for step in range(2, 6):
        stepped, root = switched.step_and_maybe_reset(root.set("action", torch.zeros(3, 2)))
        assert torch.equal(stepped["next", "noisy"], expected["next", "noisy"][:, step])


@pytest.mark.parametrize(
    ("noise", "low", "high"),
    [
        (UniformNoise(low=-0.5, high=0.25), -0.5, 1.25),
        (UniformNoise(low=0.5, high=0.75), 0.0, 1.75),
        (UniformNoise(low=-2.0, high=3.0, operation="multiply"), -2.0, 3.0),
        (ConstantNoise(value=-1.0), -1.0, 1.0),
        (UniformNoise(low=-1.0, high=1.0, bias=ConstantNoise(value=5.0)), -1.0, 7.0),
        (GaussianNoise(std=0.0, mean=1.0), 0.0, 2.0),
        (ConstantNoise(resolution=0.5), -0.25, 1.25),
        (ConstantNoise(value=3.0, dropout=0.1, lost="zero"), 0.0, 4.0),
        (ConstantNoise(walk_std=0.1), -math.inf, math.inf),
        (GaussianNoise(std=1.0), -math.inf, math.inf),
    ],
)
def test_specs_are_widened_by_the_reach_of_the_noise(noise, low, high):
    spec = counter(ObservationNoise("drawn", noise=noise)).observation_spec["drawn"]
    if math.isinf(low):
        assert type(spec).__name__.startswith("Unbounded")
    else:
        assert spec.space.low.flatten().tolist() == pytest.approx([low] * 3)
        assert spec.space.high.flatten().tolist() == pytest.approx([high] * 3)


def test_it_augments_samples_of_a_replay_buffer():
    buffer = ReplayBuffer(storage=LazyTensorStorage(100), batch_size=64)
    buffer.append_transform(ObservationNoise("obs", "noisy", noise=GaussianNoise(std=1.0)))
    buffer.extend(TensorDict({"obs": torch.zeros(100, 3)}, batch_size=100))
    first, second = buffer.sample(), buffer.sample()
    assert 0.5 < first["noisy"].std() < 1.5
    assert not (first["noisy"] == second["noisy"]).any()


def test_observations_without_a_leaf_dim_and_with_several():
    class Shaped(CounterEnv):
        def __init__(self):
            super().__init__()
            spec = self.observation_spec.clone()
            spec["flat"], spec["image"] = (
                spec["row"][:, 0].clone(),
                spec["row"].unsqueeze(-1).expand(3, 2, 4).clone(),
            )
            self.observation_spec = spec

        def _observe(self):
            observed = super()._observe()
            row = observed["row"]
            return observed | {"flat": row[:, 0], "image": row[:, :, None].expand(3, 2, 4).clone()}

    noise = ObservationNoise(["flat", "image"], ["f", "i"], noise=ConstantNoise(value=1.0))
    root = TransformedEnv(Shaped(), noise).reset()
    assert torch.equal(root["f"], root["flat"] + 1) and torch.equal(root["i"], root["image"] + 1)


def test_float64_stays_float64():
    spec = ObservationNoise("count", noise=UniformNoise(low=0.0, high=1.0))
    td = spec(TensorDict({"count": torch.zeros(5, 2, dtype=torch.float64)}, batch_size=5))
    assert td["count"].dtype == torch.float64


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ObservationNoise(["a", "b"], ["c"], noise=ConstantNoise(value=1.0)), "out_keys"),
        (
            lambda: ObservationNoise(["a", "b"], ["c", "c"], noise=ConstantNoise(value=1.0)),
            "repeats",
        ),
        (
            lambda: ObservationNoise(["a", "b"], noise=[ConstantNoise(value=1.0)]),
            "1 entries for the 2",
        ),
        (lambda: ObservationNoise(["a"], noise={"b": ConstantNoise(value=1.0)}), "one per key"),
    ],
)
def test_wrong_arguments_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_wrong_sizes_and_dtypes_are_refused_with_the_key():
    with pytest.raises(
        ValueError, match=r"GaussianNoise of \('obs', 'vector'\): std has 2 numbers.* 3 per env"
    ):
        counter(ObservationNoise(VECTOR, noise=GaussianNoise(std=(1.0, 2.0)))).output_spec  # noqa: B018
    with pytest.raises(ValueError, match="floating-point"):
        spec = CounterEnv().observation_spec.clone()
        spec["count"] = spec["count"].to(torch.int64)
        ObservationNoise("count", noise=ConstantNoise(value=1.0)).transform_observation_spec(spec)
