import math

import pytest
import torch

from ksim_rl import mdp

E = 500


def test_joints_start_at_their_defaults_without_a_range(crowd):
    crowd.fire(mdp.ResetJoints())
    # The left joint's default 0.25 lies inside its soft limits (-0.5, 0.5), the right one's 0.5 on the edge.
    torch.testing.assert_close(crowd.world.qpos_EL[:, 7:], torch.tensor([0.25, 0.5]).expand(E, 2))


def test_joint_offsets_stay_in_the_soft_limits(crowd):
    crowd.fire(mdp.ResetJoints(position_range=(-2.0, 2.0), velocity_range=(-3.0, 3.0)))
    left, right = crowd.world.qpos_EL[:, 7], crowd.world.qpos_EL[:, 8]
    assert left.min() == -0.5 and left.max() == 0.5
    assert right.min() == 0.5 and right.max() == 1.5
    assert crowd.world.qvel_EL[:, 6:].abs().max() > 2.8


def test_gaussian_offsets_have_mean_and_spread(crowd):
    event = mdp.ResetJoints(velocity_range=(1.0, 0.2), joints="left_hip", distribution="gaussian")
    crowd.fire(event)
    velocity = crowd.world.qvel_EL[:, 6]
    assert abs(velocity.mean() - 1.0) < 4.0 * 0.2 / math.sqrt(E)
    assert abs(velocity.std() - 0.2) < 4.0 * 0.2 / math.sqrt(2 * E)
    assert (crowd.world.qvel_EL[:, 7] == 0.0).all()


def test_joints_are_scaled_about_zero_within_the_soft_limits(crowd):
    crowd.fire(mdp.ResetJointsByScale(position_scale=(0.0, 3.0), velocity_range=(-1.0, 2.0)))
    left_E, right_E = crowd.world.qpos_EL[:, 7], crowd.world.qpos_EL[:, 8]
    # Defaults 0.25 and 0.5, soft limits (-0.5, 0.5) and (0.5, 1.5).
    assert (
        left_E.min() >= 0.0
        and left_E.max() == 0.5
        and right_E.min() == 0.5
        and right_E.max() <= 1.5
    )
    assert float((left_E == 0.5).float().mean()) == pytest.approx(1 / 3, abs=0.1)
    velocity = crowd.world.qvel_EL[:, 6:]
    assert velocity.min() >= -1.0 and velocity.max() <= 2.0 and velocity.std() > 0.7


def test_a_range_the_wrong_way_round_is_refused():
    with pytest.raises(ValueError, match="position_scale"):
        mdp.ResetJointsByScale(position_scale=(1.0, 0.5))
