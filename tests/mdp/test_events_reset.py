import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import FREE_BODY, Bench, Plateau

E = 400


@pytest.fixture(scope="module")
def crowd():
    return Bench(FREE_BODY, E, {}, soft_joint_pos_limit_factor=0.5)


def odd_rows():
    return torch.arange(E) % 2 == 1


def trunk_axes(crowd):
    """Return the trunk's rotation matrix in each row, as the C engine has it, [E, 3, 3]."""
    model = mujoco.MjModel.from_xml_string(FREE_BODY)
    data, axes = mujoco.MjData(model), []
    for qpos in crowd.world.qpos_EL:
        data.qpos[:] = qpos.numpy()
        mujoco.mj_kinematics(model, data)
        axes.append(data.body("trunk").xmat.reshape(3, 3).copy())
    return np.stack(axes)


def test_joints_are_scaled_about_zero_within_the_soft_limits(crowd):
    crowd.fire(mdp.ResetJointsByScale(position_scale=(0.0, 3.0), velocity_range=(-1.0, 2.0)))
    left_E, right_E = crowd.world.qpos_EL[:, 7], crowd.world.qpos_EL[:, 8]
    # Defaults 0.25 and 0.5, soft limits (-0.5, 0.5) and (0.5, 1.5).
    assert left_E.min() >= 0.0 and left_E.max() == 0.5 and right_E.min() == 0.5 and right_E.max() <= 1.5
    assert float((left_E == 0.5).float().mean()) == pytest.approx(1 / 3, abs=0.1)
    velocity = crowd.world.qvel_EL[:, 6:]
    assert velocity.min() >= -1.0 and velocity.max() <= 2.0 and velocity.std() > 0.7


def test_the_heading_is_the_drawn_one_and_the_tilt_stays(crowd):
    tilt = 0.6
    crowd.place(qpos=(0.1, 0.2, 1, math.cos(tilt / 2), math.sin(tilt / 2), 0, 0, 0, 0))
    before = crowd.world.qpos_EL.clone()
    crowd.fire(mdp.ResetHeading(heading_range=(0.5, 2.5)), odd_rows())
    assert torch.equal(crowd.world.qpos_EL[~odd_rows()], before[~odd_rows()])
    assert torch.equal(crowd.world.qpos_EL[:, :3], before[:, :3])
    axes = trunk_axes(crowd)[1::2]
    headings = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
    assert headings.min() >= 0.5 - 1e-4 and headings.max() <= 2.5 + 1e-4 and headings.std() > 0.5
    np.testing.assert_allclose(np.arccos(axes[:, 2, 2]), tilt, atol=1e-3)


def test_the_height_is_above_the_ground(crowd):
    crowd.place(qpos=(0.1, 0.2, 9.0, 1, 0, 0, 0, 0, 0))
    crowd.fire(mdp.ResetHeight(height_range=(0.3, 0.4)), odd_rows())
    heights_E = crowd.world.qpos_EL[:, 2]
    assert (heights_E[~odd_rows()] == 9.0).all()
    assert heights_E[odd_rows()].min() >= 0.3 - 1e-5 and heights_E[odd_rows()].max() <= 0.4 + 1e-5
    flat, crowd.view.terrain = crowd.view.terrain, Plateau(E, crowd.view.device)
    crowd.fire(mdp.ResetHeight(height_range=(0.3, 0.3)))
    crowd.view.terrain = flat
    torch.testing.assert_close(crowd.world.qpos_EL[:, 2], torch.full((E,), 0.55))


def test_they_may_follow_one_another_in_one_reset(crowd):
    with crowd.view.scope("events/root"):
        mdp.ResetRootUniform(pose_range={"roll": (0.3, 0.3)})(crowd.view, crowd.everybody_E)
    with crowd.view.scope("events/height"):
        mdp.ResetHeight(height_range=(2.0, 2.0))(crowd.view, crowd.everybody_E)
    crowd.fire(mdp.ResetHeading(heading_range=(1.0, 1.0)))
    torch.testing.assert_close(crowd.world.qpos_EL[:, :3], torch.tensor([1.0, 2.0, 2.0]).expand(E, 3))
    torch.testing.assert_close(crowd.view.heading_E, torch.ones(E))
    torch.testing.assert_close(crowd.view.projected_gravity_EL[:, 2], torch.full((E,), -math.cos(0.3)))


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: mdp.ResetJointsByScale(position_scale=(1.0, 0.5)), "position_scale"),
        (lambda: mdp.ResetHeading(heading_range=(0.0, math.nan)), r"heading_range\[1\]"),
        (lambda: mdp.ResetHeight(height_range=(1.0, 0.5)), "height_range"),
    ],
)
def test_what_does_not_fit_is_refused(make, field):
    with pytest.raises(ValueError, match=field):
        make()
