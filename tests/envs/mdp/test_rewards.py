import torch

from ksim_rl.envs import mdp


def test_action_rate_is_the_squared_change(free_body):
    free_body.view.action_EL = torch.tensor([[1.0, 2.0], [0.0, 0.0], [-1.0, 1.0]])
    free_body.view.last_action_EL = torch.tensor([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    assert free_body.read(mdp.ActionRateL2(), "rewards/x").tolist() == [5.0, 0.0, 4.0]


def test_joint_velocity_and_force_penalties_take_named_parts(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0.5), qvel=(0, 0, 0, 0, 0, 0, 3, 4))
    assert free_body.read(mdp.JointVelL2(), "rewards/x").tolist() == [25.0] * 3
    assert free_body.read(mdp.JointVelL2(joints="left_hip"), "rewards/x").tolist() == [9.0] * 3
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0.5), qvel=torch.zeros(8))
    free_body.world.ctrl_EL.copy_(torch.tensor([0.7, 2.0]).expand(3, 2))
    free_body.world.step(1)
    # A position servo of kp 10 that is 0.2 rad off, and a motor at control 2 (its gear acts behind the force).
    forces = free_body.read(mdp.ActuatorForceL2(), "rewards/x")
    torch.testing.assert_close(forces, torch.full((3,), 2.0**2 + 2.0**2), atol=1e-3, rtol=0)


def test_alive_is_one(free_body):
    assert free_body.read(mdp.Alive(), "rewards/x").tolist() == [1.0, 1.0, 1.0]
