import math

import pytest
import torch

from ksim_rl.envs import mdp

HALF = math.sqrt(0.5)
YAW_90 = (HALF, 0.0, 0.0, HALF)


def test_linear_tracking_compares_in_the_roots_frame(free_body):
    # Heading along world y at 1 m/s, climbing at 0.2 m/s.
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0), qvel=(0, 1, 0.2, 0, 0, 0, 0, 0))
    free_body.command([[1.0, 0.0, 5.0], [0.0, 1.0, 5.0], [0.7, -0.4, 5.0]])
    value = free_body.read(mdp.TrackLinearVelocity(command="twist", std=0.5), "rewards/x")
    squared = torch.tensor([0.0, 1.0 + 1.0, 0.09 + 0.16]) + 0.04
    torch.testing.assert_close(value, torch.exp(-squared / 0.25), atol=1e-5, rtol=0)


def test_angular_tracking_punishes_roll_and_pitch_rates(free_body):
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0), qvel=(0, 0, 0, 0.3, 0.4, 0.5, 0, 0))
    free_body.command([[9.0, 9.0, 0.5], [9.0, 9.0, -0.5], [9.0, 9.0, 0.0]])
    value = free_body.read(mdp.TrackAngularVelocity(command="twist", std=math.sqrt(0.5)), "rewards/x")
    squared = torch.tensor([0.0, 1.0, 0.25]) + 0.25
    torch.testing.assert_close(value, torch.exp(-squared / 0.5), atol=1e-5, rtol=0)


@pytest.mark.parametrize("std", [0.0, -1.0, float("nan")])
def test_std_must_be_positive(std):
    with pytest.raises(ValueError, match="std"):
        mdp.TrackLinearVelocity(command="twist", std=std)
