import math

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    ActionDelay,
    ConstantNoise,
    DelayCfg,
    GaussianNoise,
    ObservationClip,
    ObservationDelay,
    ObservationHistory,
    ObservationNoise,
    UniformNoise,
    follow_level,
)
from tests.transforms.chains import VECTOR, assert_same, counter, fixed_rollout


@pytest.mark.parametrize("level", [0.0, 0.25, 1.0])
def test_it_scales_additive_and_multiplicative_noise(level):
    bias = ConstantNoise(value=10.0)
    transforms = [
        ObservationNoise("count", "plus", noise=ConstantNoise(value=2.0, bias=bias, by_level=True)),
        ObservationNoise(
            "count", "times", noise=ConstantNoise(value=3.0, operation="multiply", by_level=True)
        ),
        ObservationNoise("count", "always", noise=ConstantNoise(value=2.0)),
        ObservationNoise(
            "count", "rounded", noise=ConstantNoise(value=0.1, resolution=4.0, by_level=True)
        ),
    ]
    env = counter(*transforms)
    follow_level(transforms, level)
    rollout_ET = fixed_rollout(env, 8)
    count = rollout_ET["count"]
    assert torch.equal(rollout_ET["plus"], count + 12 * level)
    assert torch.equal(rollout_ET["times"], count * (1 + 2 * level))
    assert torch.equal(rollout_ET["always"], count + 2)
    step = 4.0 * level
    expected = ((count + 0.1 * level) / step).round() * step if step else count
    assert torch.equal(rollout_ET["rounded"], expected)


def test_random_noise_walk_and_dropout_shrink_with_it():
    noise = GaussianNoise(std=1.0, by_level=True)
    walk = ConstantNoise(walk_std=1.0, by_level=True)
    lossy = ConstantNoise(value=1.0, dropout=1.0, lost="zero", by_level=True)
    env = counter(
        ObservationNoise(VECTOR, "noisy", noise=noise).follow_level_(0.5),
        ObservationNoise(VECTOR, "drifting", noise=walk).follow_level_(0.5),
        ObservationNoise("count", "lossy", noise=lossy).follow_level_(0.5),
        lengths=(2,) * 1000,
    )
    rollout_ET = fixed_rollout(env, 80)
    added = rollout_ET["noisy"] - rollout_ET[VECTOR]
    assert abs(added.std() - 0.5) < 4 * 0.5 / math.sqrt(2 * added.numel())
    drift = (rollout_ET["drifting"] - rollout_ET[VECTOR])[:, 1::2]
    assert abs(drift.std() - 0.5) < 4 * 0.5 / math.sqrt(2 * drift.numel())
    lost = (rollout_ET["lossy"] == 0)[:, 1::2].float()
    assert abs(lost.mean() - 0.5) < 4 * 0.5 / math.sqrt(lost.numel())


@pytest.mark.parametrize(("level", "largest"), [(0.0, 1), (0.3, 2), (0.5, 3), (1.0, 5)])
def test_it_sets_the_reach_of_lags(level, largest):
    delay = DelayCfg(min_lag=1, max_lag=5, by_level=True)
    env = counter(
        ObservationDelay("count", "late", delay=delay).follow_level_(level),
        ActionDelay(delay=delay).follow_level_(level),
        lengths=(4,) * 200,
    )
    for transform in env.transform:
        env.reset()
        # 1 + 4 * level, rounded half to even as torch does.
        assert set(transform.lag_E.tolist()) == set(range(1, largest + 1))


def test_a_tensor_is_followed_wherever_it_changes_and_without_it_the_level_is_full():
    noise = ObservationNoise("count", "noisy", noise=UniformNoise(low=1.0, high=2.0, by_level=True))
    env = counter(noise)
    root = env.reset()
    assert bool((root["noisy"] >= 1).all())
    level = torch.zeros(())
    noise.follow_level_(level)
    root = env.reset()
    assert torch.equal(root["noisy"], root["count"])
    level.fill_(1.0)
    assert bool((env.reset()["noisy"] >= 1).all())


def test_the_level_is_part_of_the_state_where_it_is_used():
    def build(by_level):
        noise = GaussianNoise(std=1.0, by_level=by_level)
        return MaskedTransformedEnv(counter().base_env, [ObservationNoise("count", noise=noise)])

    env, resumed = build(True), build(True)
    env.transform[0].follow_level_(0.25)
    env.reset()
    resumed.load_state_dict(env.state_dict())
    assert float(resumed.transform[0].level) == 0.25
    assert not any("level" in key for key in build(False).state_dict())


def test_noise_that_follows_full_level_equals_noise_that_follows_none():
    def run(**fields):
        noise = GaussianNoise(
            std=0.3, bias=UniformNoise(low=0.5, high=1.5, operation="multiply"), **fields
        )
        env = counter(ObservationNoise([VECTOR, "row"], noise=noise))
        env.set_seed(3)
        return fixed_rollout(env, 10)

    assert_same(run(by_level=True), run())


@pytest.mark.parametrize("level", [-0.1, 1.5, torch.zeros(2), torch.zeros((), dtype=torch.float64)])
def test_wrong_levels_are_refused(level):
    with pytest.raises(ValueError, match="level"):
        ObservationNoise("count", noise=ConstantNoise(value=1.0)).follow_level_(level)


def test_one_is_appended_to_the_chain_of_an_env_that_runs_already():
    env = TransformedEnv(CounterEnv((3, 5, 4)), Compose(ObservationClip("count", clip=(0.0, 2.0))))
    env.rollout(3, break_when_any_done=False)
    env.transform.append(ObservationHistory("count", length=3))
    assert env.rollout(3, break_when_any_done=False)["count"].shape == (3, 3, 3)
