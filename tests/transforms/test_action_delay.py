import pytest
import torch
from torchrl.envs import TransformedEnv

from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ActionDelay, DelayCfg
from tests.transforms.chains import actions, counter, fixed_rollout


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_the_env_receives_the_action_of_lag_steps_ago(lag):
    """The reward is the sum of the action that the env received."""
    lengths = (3, 5, 20)
    env = counter(
        ActionDelay(delay=DelayCfg(min_lag=lag, max_lag=lag), initial=0.5), lengths=lengths
    )
    rollout_ET = fixed_rollout(env, 15)
    sent = actions(15, env).transpose(0, 1).sum(-1)
    assert torch.equal(rollout_ET["action"].sum(-1), sent)
    for row in range(3):
        for step in range(15):
            within = int(rollout_ET["count"][row, step, 0])
            expected = sent[row, step - lag] if within >= lag else torch.tensor(1.0)
            assert rollout_ET["next", "reward"][row, step, 0] == expected, (row, step)


def test_a_random_lag_is_one_of_those_allowed():
    env = counter(ActionDelay(delay=DelayCfg(max_lag=2, resample_every=1)), lengths=(50,) * 200)
    rollout_ET = fixed_rollout(env, 30)
    sent, received = rollout_ET["action"].sum(-1), rollout_ET["next", "reward"][..., 0]
    shifts = torch.stack([received[:, 2:] == sent[:, 2 - lag : 30 - lag] for lag in range(3)])
    assert bool(shifts.any(0).all())
    assert bool((abs(shifts.float().mean((1, 2)) - 1 / 3) < 0.03).all())


def test_another_key_for_the_policy():
    env = counter(ActionDelay("action", "wish", delay=DelayCfg(min_lag=1, max_lag=1)))
    assert env.action_key == "wish"
    stepped = env.step(env.reset().set("wish", torch.ones(3, 2)))
    assert bool((stepped["next", "reward"] == 0).all())
    assert "action" not in stepped


def test_wrong_actions_are_refused_with_both_shapes():
    env = counter(ActionDelay(delay=DelayCfg(max_lag=2)))
    with pytest.raises(ValueError, match=r"\(3, 5\).*expected \(3, 2\)"):
        env.step(env.reset().set("action", torch.zeros(3, 5)))
    with pytest.raises(ValueError, match="float64"):
        env.step(env.reset().set("action", torch.zeros(3, 2, dtype=torch.float64)))


def test_a_refused_action_leaves_no_trace():
    env = TransformedEnv(CounterEnv(), ActionDelay(delay=DelayCfg(max_lag=2)))
    root = env.reset()
    with pytest.raises(ValueError):
        env.step(root.clone().set("action", torch.zeros(3, 5)))
    assert int(env.transform.step_count) == 0
