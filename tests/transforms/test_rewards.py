"""Scale and limits of rewards."""

import pytest
import torch
from torchrl.envs.transforms import RewardClipping, RewardScaling

from ksim_rl.transforms import RewardClip, RewardScale
from tests.transforms.chains import counter, fixed_rollout


def test_scale_equals_torchrls():
    ours = RewardScale("reward", "ours", scale=0.5, offset=-1.0)
    env = counter(ours, RewardScaling(loc=-1.0, scale=0.5, in_keys=["reward"], out_keys=["theirs"]))
    rollout_ET = fixed_rollout(env, 8)
    assert torch.equal(rollout_ET["next", "ours"], rollout_ET["next", "theirs"])
    assert not torch.equal(rollout_ET["next", "ours"], rollout_ET["next", "reward"])


def test_clip_equals_torchrls():
    ours = RewardClip("reward", "ours", clip=(-0.5, 0.25))
    env = counter(ours, RewardClipping(-0.5, 0.25, in_keys=["reward"], out_keys=["theirs"]))
    rollout_ET = fixed_rollout(env, 8)
    assert torch.equal(rollout_ET["next", "ours"], rollout_ET["next", "theirs"])
    assert not torch.equal(rollout_ET["next", "ours"], rollout_ET["next", "reward"])


def test_bounds_follow():
    env = counter(
        RewardClip(clip=(-1.0, 0.5)), RewardScale(scale=-2.0, offset=1.0, first_scale=-4.0)
    )
    space = env.full_reward_spec["reward"].space
    assert (space.low.unique().tolist(), space.high.unique().tolist()) == ([-1.0], [5.0])


def test_the_scale_follows_the_level():
    level = torch.zeros(())
    scale = RewardScale("reward", "weighted", scale=3.0, first_scale=1.0).follow_level_(level)
    env = counter(scale)
    for value, factor in ((0.0, 1.0), (0.5, 2.0), (1.0, 3.0)):
        level.fill_(value)
        reached = env.rand_step(env.reset())["next"]
        assert torch.equal(reached["weighted"], factor * reached["reward"])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: RewardScale(scale=float("nan")), "scale=nan"),
        (lambda: RewardScale(scale=1.0, offset="1"), "offset='1'"),
        (lambda: RewardClip(clip=(1.0, 0.0)), "low < high"),
        (lambda: RewardClip(["a", "b"], ["c"], clip=(0.0, 1.0)), "out_keys"),
    ],
)
def test_wrong_values_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
