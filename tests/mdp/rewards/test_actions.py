import pytest
import torch

from ksim_rl import mdp
from tests.envs.probe_env import puck_env_in_c


def test_action_rate_is_the_squared_change(free_body):
    free_body.driver.readings.action_EL = torch.tensor([[1.0, 2.0], [0.0, 0.0], [-1.0, 1.0]])
    free_body.driver.readings.last_action_EL = torch.tensor([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    assert free_body.read(mdp.ActionRateL2(), "rewards/x").tolist() == [5.0, 0.0, 4.0]


def act(bench, term, polynomial, steps):
    """Values of a term while each env's two actions follow `polynomial(k)`, from k = 0 on; before, they are 0."""
    readings, values = bench.driver.readings, []
    readings.action_EL = torch.zeros(3, 2)
    for k in range(steps):
        readings.last_action_EL = readings.action_EL
        readings.action_EL = torch.full((3, 2), float(polynomial(k)))
        values.append(bench.read(term, "rewards/x"))
    return torch.stack(values, dim=-1)


def test_action_acceleration_is_the_second_difference(free_body):
    # Of 1, 1, 1, ...: 1, -1, 0, ...; of k^2 it is 2 throughout, once k = -1 is out of sight.
    values = act(free_body, mdp.ActionAccelerationL2(), lambda k: 1.0, 4)
    assert values.tolist() == [[2.0, 2.0, 0.0, 0.0]] * 3
    free_body.view.buffers.clear(torch.tensor([True, True, True]))
    values = act(free_body, mdp.ActionAccelerationL2(), lambda k: k**2, 6)
    assert values[:, 2:].tolist() == [[2 * 2.0**2] * 4] * 3


def test_action_jerk_is_the_third_difference(free_body):
    values = act(free_body, mdp.ActionJerkL2(), lambda k: 1.0, 5)
    assert values.tolist() == [[2.0, 8.0, 2.0, 0.0, 0.0]] * 3
    free_body.view.buffers.clear(torch.tensor([True, False, True]))
    values = act(free_body, mdp.ActionJerkL2(), lambda k: k**3, 7)
    assert values[:, 3:].tolist() == [[2 * 6.0**2] * 4] * 3
    # The row that was not cleared remembers the rate 0 and the acceleration 0 of before; the others start with them.
    assert torch.equal(values[0], values[2])


def test_alive_is_one(free_body):
    assert free_body.read(mdp.Alive(), "rewards/x").tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("is_finite_horizon", [False, True])
def test_terminated_marks_failures_and_no_time_outs(is_finite_horizon):
    # Env e starts at e + 1 m/s and fails beyond 0.1 m: in steps 6, 3 and 2 of 20 ms. Time is out after 3 steps.
    env = puck_env_in_c(
        rewards={"failed": mdp.Terminated(weight=-2.0)},
        scale_rewards_by_dt=False,
        episode_length_s=0.06,
        is_finite_horizon=is_finite_horizon,
    )
    root_E = env.reset()
    rewards = []
    for _ in range(3):
        step_E = env.step(root_E.set("action", torch.zeros(3, 1)))
        rewards.append(step_E["next", "reward"][:, 0].tolist())
        root_E = step_E["next"].exclude("reward")
    ended = step_E["next", "terminated" if is_finite_horizon else "truncated"]
    assert ended[0], "the first env's time is out"
    assert rewards == [[0.0, 0.0, 0.0], [0.0, 0.0, -2.0], [0.0, -2.0, -2.0]]
