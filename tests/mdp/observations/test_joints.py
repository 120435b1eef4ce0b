import torch

from ksim_rl import mdp
from tests.mdp.bench import TWO_WHEELS


def close(value, expected, atol=1e-5):
    torch.testing.assert_close(value, torch.as_tensor(expected).expand_as(value), atol=atol, rtol=0)


def test_joints_come_in_the_order_that_is_asked_for(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.7, 0.9), qvel=(0, 0, 0, 0, 0, 0, 3, 4))
    close(free_body.read(mdp.JointPos()), [0.7, 0.9])
    close(free_body.read(mdp.JointPos(joints=("right_hip", "left_hip"))), [0.9, 0.7])
    close(free_body.read(mdp.JointVel(joints="right.*")), [4.0])
    close(free_body.read(mdp.JointPosRel()), [0.7 - 0.25, 0.9 - 0.5])


def test_encoder_bias_reaches_biased_readings_only(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.25, 0.5))
    free_body.view.encoder_bias_EL.copy_(torch.tensor([0.01, -0.02]).expand(3, 2))
    close(free_body.read(mdp.JointPosRel(biased=True)), [0.01, -0.02])
    close(free_body.read(mdp.JointPos(biased=True)), [0.26, 0.48])
    close(free_body.read(mdp.JointPosRel()), [0.0, 0.0])
    close(free_body.read(mdp.JointPos()), [0.25, 0.5])


def test_efforts_stand_behind_the_gear_and_accelerations_follow_newton(make_bench):
    bench = make_bench(TWO_WHEELS, 2)
    bench.world.ctrl_EL.copy_(torch.tensor([[-1.0, 3.0], [0.0, 0.5]]))
    bench.step()
    # Actuators: right (gear 1), left (gear 2); inertias of the wheels left and right: 0.5 and 0.25 kg m^2.
    close(bench.read(mdp.ActuatorForce()), [[-1.0, 3.0], [0.0, 0.5]])
    close(bench.read(mdp.ActuatorForce(actuators="left")), [[3.0], [0.5]])
    close(bench.read(mdp.JointEffort()), [[6.0, -1.0], [1.0, 0.0]])
    close(bench.read(mdp.JointEffort(joints=("right", "left"))), [[-1.0, 6.0], [0.0, 1.0]])
    close(bench.read(mdp.JointAcc()), [[12.0, -4.0], [2.0, 0.0]], atol=1e-4)
    close(bench.read(mdp.JointAcc(joints="right")), [[-4.0], [0.0]], atol=1e-4)
