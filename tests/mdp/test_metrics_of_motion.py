import torch

from ksim_rl import mdp


def test_velocity_errors(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0), qvel=(1, 2, 9, 0, 0, 0.5, 0, 0))
    free_body.command([4.0, 6.0, -0.25])
    linear = free_body.read(mdp.LinearVelocityError(command="twist"), "metrics/x")
    angular = free_body.read(mdp.AngularVelocityError(command="twist"), "metrics/x")
    torch.testing.assert_close(linear, torch.full((3,), 5.0), atol=1e-5, rtol=0)
    torch.testing.assert_close(angular, torch.full((3,), 0.75), atol=1e-5, rtol=0)


def test_action_acceleration_is_the_second_difference(free_body):
    actions = [0.0, 1.0, 3.0, 3.0]  # after zeros: second differences 0, 1, 1, -2
    last, seen = 0.0, []
    for action in actions:
        free_body.driver.readings.action_EL = torch.full((3, 2), action)
        free_body.driver.readings.last_action_EL = torch.full((3, 2), last)
        seen.append(float(free_body.read(mdp.ActionAcceleration(), "metrics/acc")[0]))
        last = action
    assert seen == [0.0, 1.0, 1.0, 2.0]
