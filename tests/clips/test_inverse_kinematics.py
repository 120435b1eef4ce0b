"""Inverse kinematics: what can be reached is reached, and what cannot stays inside the joints' ranges."""

import mujoco
import numpy as np
import pytest

from ksim_rl.clips.inverse_kinematics import ComGoal, InverseKinematics, PoseGoal
from tests.tracking.g1 import g1_model

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 1 0 0" size="0.05"/>
      <body name="fore" pos="1 0 0">
        <joint name="elbow" axis="0 0 1" limited="true" range="0 2.5"/>
        <geom type="capsule" fromto="0 0 0 1 0 0" size="0.05"/>
        <site name="hand" pos="1 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def arm():
    return mujoco.MjModel.from_xml_string(ARM)


def test_two_links_reach_a_point_as_the_law_of_cosines_says(arm):
    solver, target_3 = InverseKinematics(arm), np.array((0.9, 1.1, 0.0))
    found = solver.solve(
        [PoseGoal(name="hand", pos_3=target_3)], start_L=np.array((0.0, 0.3)), posture_weight_M=0.0
    )
    far = np.hypot(*target_3[:2])
    elbow = np.pi - np.arccos((2.0 - far**2) / 2.0)
    assert found[1] == pytest.approx(elbow, abs=1e-6)
    assert found[0] == pytest.approx(np.arctan2(1.1, 0.9) - elbow / 2, abs=1e-6)


def test_what_is_out_of_reach_leaves_the_arm_stretched_toward_it(arm):
    far_3 = np.array((0.0, 5.0, 0.0))
    found = InverseKinematics(arm).solve(
        [PoseGoal(name="hand", pos_3=far_3)], start_L=np.array((0.0, 1.0)), posture_weight_M=1e-6
    )
    assert found == pytest.approx([np.pi / 2, 0.0], abs=0.05)


def test_a_range_is_not_left_where_the_goal_lies_beyond_it(arm):
    # Stretched and bent the wrong way: the elbow's range ends at 0.
    wrong_3 = np.array((np.cos(-0.5) + 1.0, np.sin(-0.5), 0.0))
    found = InverseKinematics(arm).solve(
        [
            PoseGoal(name="hand", pos_3=wrong_3, weight=1.0),
            PoseGoal(name="fore", pos_3=np.array((1.0, 0.0, 0.0))),
        ],
        start_L=np.array((0.0, 0.5)),
        posture_weight_M=0.0,
    )
    assert found[1] == 0.0
    assert -0.5 < found[0] < 0.0, "the shoulder shares the error between both"


def test_a_robot_finds_back_to_where_its_feet_hands_and_mass_were():
    model = g1_model()
    data, draw = mujoco.MjData(model), np.random.default_rng(0)
    start_L = model.key_qpos[0]
    data.qpos[:] = start_L
    low, high = model.jnt_range[1:].T
    data.qpos[7:] = np.clip(start_L[7:] + draw.uniform(-0.3, 0.3, 29), low, high)
    data.qpos[:3] += (0.1, -0.05, -0.03)
    mujoco.mj_forward(model, data)
    sites = ("left_foot", "right_foot", "left_palm", "right_palm")
    goals = []
    for site in sites:
        quat_4 = np.empty(4)
        mujoco.mju_mat2Quat(quat_4, data.site(site).xmat)
        goals.append(PoseGoal(name=site, pos_3=data.site(site).xpos.copy(), quat_4=quat_4))
    com_3 = data.subtree_com[0].copy()
    found = InverseKinematics(model).solve(
        [*goals, ComGoal(pos_N=com_3)], start_L=start_L, posture_weight_M=1e-4
    )
    data.qpos[:] = found
    mujoco.mj_forward(model, data)
    for site, goal in zip(sites, goals, strict=True):
        assert data.site(site).xpos == pytest.approx(goal.pos_3, abs=1e-4)
    assert data.subtree_com[0] == pytest.approx(com_3, abs=1e-4)
    assert (data.qpos[7:] >= low).all() and (data.qpos[7:] <= high).all()


def test_a_part_that_does_not_exist_gives_the_near_names(arm):
    with pytest.raises(ValueError, match="no site or body 'hnad'.*'hand'"):
        InverseKinematics(arm).check_names(["upper", "hnad"])
