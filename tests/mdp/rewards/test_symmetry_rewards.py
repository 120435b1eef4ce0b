import pytest
import torch

from ksim_rl import mdp

FOUR_JOINTS = """
<mujoco>
  <worldbody>
    <body><joint name="left_hip"/><geom size="0.1" contype="0" conaffinity="0"/>
      <body><joint name="left_knee"/><geom size="0.1" contype="0" conaffinity="0"/></body>
    </body>
    <body><joint name="right_hip"/><geom size="0.1" contype="0" conaffinity="0"/>
      <body><joint name="right_knee"/><geom size="0.1" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
  <keyframe><key qpos="0.1 0.2 -0.1 0.2"/></keyframe>
</mujoco>
"""
MIRROR = {"left": "left_.*", "right": "right_.*", "signs": {".*_hip": -1.0, ".*_knee": 1.0}}


@pytest.fixture
def bench(make_bench):
    return make_bench(FOUR_JOINTS, 3)


def test_a_mirrored_pose_is_symmetric(bench):
    # Deviations (left hip, left knee, right hip, right knee) from the default pose, which is symmetric itself.
    bench.place(
        qpos=torch.tensor([0.1, 0.2, -0.1, 0.2])
        + torch.tensor([[0.3, 0.4, -0.3, 0.4], [0.3, 0.4, 0.3, 0.4], [0.0, 0.5, 0.0, 0.2]])
    )
    value = bench.read(mdp.JointSymmetryL2(**MIRROR), "rewards/x")
    torch.testing.assert_close(value, torch.tensor([0.0, 0.36, 0.09]), atol=1e-6, rtol=0)
    same = mdp.JointSymmetryL2(left="left_.*", right="right_.*")
    torch.testing.assert_close(
        bench.read(same, "rewards/x"), torch.tensor([0.36, 0.0, 0.09]), atol=1e-6, rtol=0
    )


def test_actions_stand_in_the_order_of_the_action_term(bench):
    order = ("right_knee", "left_hip", "right_hip", "left_knee")
    term = mdp.ActionSymmetryL2(joints=order, **MIRROR)
    # The last column belongs to another action term.
    bench.driver.readings.action_EL = torch.tensor(
        [[0.5, 0.3, -0.3, 0.5, 9.0], [0.5, 0.3, 0.3, 0.5, 9.0], [0.1, 0.0, 0.0, 0.5, 9.0]]
    )
    value = bench.read(term, "rewards/x")
    torch.testing.assert_close(value, torch.tensor([0.0, 0.36, 0.16]), atol=1e-6, rtol=0)


def test_unpaired_joints_and_odd_signs_are_refused(bench):
    with pytest.raises(ValueError, match=r"left matches \['left_hip'\].*give each left joint one"):
        bench.read(mdp.JointSymmetryL2(left="left_hip", right="right_.*"), "rewards/x")
    with pytest.raises(ValueError, match="'right_knee' of a pair is not among them"):
        bench.read(mdp.ActionSymmetryL2(joints=("left_.*", "right_hip"), **MIRROR), "rewards/x")
    with pytest.raises(ValueError, match=r"signs\['.\*'\]=0.5"):
        mdp.JointSymmetryL2(left="a", right="b", signs={".*": 0.5})
