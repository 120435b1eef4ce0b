"""Scale, limits and smoothing of actions. The counter env pays the sum of the action that it receives."""

import pytest
import torch
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.transforms import ActionScaling

from ksim_rl.transforms import ActionClip, ActionLowPass, ActionScale
from tests.transforms.chains import actions, counter, fixed_rollout


def received(env, num_steps=10):
    return fixed_rollout(env, num_steps)["next", "reward"][..., 0]


def sent(env, num_steps=10):
    return actions(num_steps, env).transpose(0, 1)


def test_clip():
    env = counter(ActionClip(clip=(-0.25, 0.5)))
    assert torch.equal(received(env), sent(env).clamp(-0.25, 0.5).sum(-1))


def test_the_policy_of_a_clipped_env_may_ask_for_anything():
    env = counter(ActionClip(clip=(-0.25, 0.5)))
    assert env.action_spec.is_in(torch.full((3, 2), 100.0))
    assert not counter().action_spec.is_in(torch.full((3, 2), 100.0))


def test_scale_and_offset_per_element():
    env = counter(ActionScale(scale=(0.5, -0.25), offset=(0.1, 0.0)))
    expected = sent(env) * torch.tensor([0.5, -0.25]) + torch.tensor([0.1, 0.0])
    torch.testing.assert_close(received(env), expected.sum(-1))
    space = env.action_spec.space
    torch.testing.assert_close(space.low[0], torch.tensor([-2.2, -4.0]))
    torch.testing.assert_close(space.high[0], torch.tensor([1.8, 4.0]))


def test_scale_from_the_bounds_equals_torchrls():
    ours, theirs = (
        TransformedEnv(GymEnv("Pendulum-v1"), t) for t in (ActionScale(), ActionScaling())
    )
    assert ours.action_spec == theirs.action_spec
    for env in (ours, theirs):
        env.set_seed(0)
    rollouts = [fixed_rollout(env, 20) for env in (ours, theirs)]
    torch.testing.assert_close(
        rollouts[0]["next", "observation"], rollouts[1]["next", "observation"]
    )
    torch.testing.assert_close(rollouts[0]["action"], rollouts[1]["action"])
    bare = GymEnv("Pendulum-v1")
    bare.set_seed(0)
    unscaled = fixed_rollout(bare, 20)["next", "observation"]
    assert not torch.allclose(rollouts[0]["next", "observation"], unscaled)


@pytest.mark.parametrize("initial", [None, 0.0, 0.75])
def test_low_pass_equals_the_recursion_over_resets(initial):
    lengths, alpha = (3, 5, 20), 0.3
    env = counter(ActionLowPass(alpha=alpha, initial=initial), lengths=lengths)
    rollout_ET, wanted = fixed_rollout(env, 15), sent(env, 15).double()
    for row in range(3):
        for step in range(15):
            if rollout_ET["count"][row, step] == 0:
                y = wanted[row, step] if initial is None else torch.full((2,), initial).double()
            y = y + alpha * (wanted[row, step] - y)
            found = rollout_ET["next", "reward"][row, step, 0]
            assert float(found) == pytest.approx(float(y.sum()), abs=1e-6), (row, step)


def test_alpha_1_filters_nothing():
    env = counter(ActionLowPass(alpha=1.0, initial=5.0))
    assert torch.equal(received(env), sent(env).sum(-1))


@pytest.mark.parametrize(
    "build",
    [
        lambda: ActionScale("action", "wish"),
        lambda: ActionClip("action", "wish", clip=(-1.0, 1.0)),
        lambda: ActionLowPass("action", ("my", "wish"), alpha=1.0),
    ],
)
def test_another_key_for_the_policy(build):
    env = counter(build())
    key = env.action_key
    assert key in ("wish", ("my", "wish"))
    stepped = env.step(env.reset().set(key, torch.full((3, 2), 0.5)))
    assert bool((stepped["next", "reward"] == 1).all())
    assert "action" not in stepped


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ActionScale(offset=1.0), "without scale"),
        (lambda: ActionScale(scale=(1.0, 0.0)), "other than 0"),
        (lambda: counter(ActionScale(scale=(1.0, 1.0, 1.0))).input_spec, "3 numbers"),
        (
            lambda: counter(ActionScale(), ActionClip(clip=(0.0, 1.0)), ActionScale()).input_spec,
            "finite bounds",
        ),
        (lambda: ActionLowPass(alpha=0.0), "alpha=0.0"),
        (lambda: ActionLowPass(alpha=0.5, initial=float("inf")), "initial=inf"),
        (lambda: ActionClip(clip=(None, None)), "clip="),
    ],
)
def test_wrong_values_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
