import pytest
import torch

from ksim_rl.envs import mdp

# Controls stand in the order (right, left) in this model, joints in the order (left, right).
ACTION = torch.tensor([[1.0, 2.0], [0.0, 0.0], [-1.0, 0.5]])


def run(bench, term, action=ACTION):
    with bench.view.scope("actions/x"):
        term(bench.view, action)
    return bench.world.ctrl_EL


def test_position_targets_reach_the_actuators_of_their_joints(free_body):
    term = mdp.JointPositionAction(joints=("left_hip", "right_hip"), scale=0.5)
    ctrl = run(free_body, term)
    torch.testing.assert_close(ctrl[:, 1], 0.25 + 0.5 * ACTION[:, 0])
    torch.testing.assert_close(ctrl[:, 0], 0.5 + 0.5 * ACTION[:, 1])
    assert term.size(free_body.view) == 2


def test_columns_follow_the_order_of_the_term(free_body):
    ctrl = run(free_body, mdp.JointPositionAction(joints=("right_hip", "left_hip"), use_default_offset=False))
    torch.testing.assert_close(ctrl, ACTION)


def test_scale_by_joint_and_clip_before_scaling(free_body):
    term = mdp.JointPositionAction(
        joints=".*", scale={"left.*": 2.0, "right.*": 3.0}, use_default_offset=False, clip=(-0.5, 1.0)
    )
    ctrl = run(free_body, term)
    torch.testing.assert_close(ctrl[:, 1], torch.tensor([2.0, 0.0, -1.0]))
    torch.testing.assert_close(ctrl[:, 0], torch.tensor([3.0, 0.0, 1.5]))


def test_some_joints_leave_the_other_controls_alone(free_body):
    free_body.world.ctrl_EL.fill_(7.0)
    ctrl = run(free_body, mdp.JointPositionAction(joints="left_hip", use_default_offset=False), ACTION[:, :1])
    torch.testing.assert_close(ctrl[:, 1], ACTION[:, 0])
    assert (ctrl[:, 0] == 7.0).all()


def test_effort_stays_in_the_control_range(free_body):
    ctrl = run(free_body, mdp.JointEffortAction(joints="left_hip", scale=5.0), ACTION[:, :1])
    torch.testing.assert_close(ctrl[:, 1], torch.tensor([3.0, 0.0, -2.0]))
    ctrl = run(free_body, mdp.JointEffortAction(joints="right_hip", scale=5.0), ACTION[:, 1:])
    torch.testing.assert_close(ctrl[:, 0], 5.0 * ACTION[:, 1])  # no range, no bound


def test_scale_must_name_each_joint(free_body):
    with pytest.raises(ValueError, match=r"scale.*right_hip"):
        run(free_body, mdp.JointPositionAction(joints=".*", scale={"left_hip": 1.0}))
