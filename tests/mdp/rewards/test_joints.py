import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import TWO_WHEELS


@pytest.fixture
def wheels(make_bench):
    """Wheels after one env step under constant torque: efforts (6, -1) and (1, 0) N m on left and right."""
    bench = make_bench(TWO_WHEELS, 2)
    bench.world.ctrl_EL.copy_(torch.tensor([[-1.0, 3.0], [0.0, 0.5]]))
    bench.step()
    return bench


def check(bench, term, expected, atol=1e-5):
    torch.testing.assert_close(
        bench.read(term, "rewards/x"), torch.tensor(expected), atol=atol, rtol=1e-5
    )


def test_position_limits_count_the_overshoot_of_the_soft_range(free_body):
    # Half of (-1, 1) is (-0.5, 0.5), half of (0, 2) is (0.5, 1.5).
    free_body.place(
        qpos=[(0, 0, 1, 1, 0, 0, 0, *angles) for angles in ((0.4, 1.4), (-0.7, 1.6), (0.8, 0.1))]
    )
    check(free_body, mdp.JointPosLimits(), [0.0, 0.3, 0.7])
    check(free_body, mdp.JointPosLimits(joints="left_hip"), [0.0, 0.2, 0.3])


def test_deviation_is_from_the_default_pose(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.25 - 0.3, 0.5 + 0.4))
    check(free_body, mdp.JointDeviationL1(), [0.7] * 3)
    check(free_body, mdp.JointDeviationL2(), [0.25] * 3)
    check(free_body, mdp.JointDeviationL1(joints="right_hip"), [0.4] * 3)
    check(free_body, mdp.JointDeviationL2(joints="left_hip"), [0.09] * 3)


def test_velocity_penalties_take_named_joints(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0.5), qvel=(0, 0, 0, 0, 0, 0, 3, -4))
    check(free_body, mdp.JointVelL2(), [25.0] * 3)
    check(free_body, mdp.JointVelL2(joints="left_hip"), [9.0] * 3)
    limits = {"left.*": 5.0, "right.*": 3.5}
    check(free_body, mdp.JointVelLimits(limits=limits), [0.5] * 3)
    check(free_body, mdp.JointVelLimits(limits=limits, soft_factor=0.4), [1.0 + 2.6] * 3)
    check(free_body, mdp.JointVelLimits(joints="left_hip", limits={".*": 1.0}), [2.0] * 3)


def test_acceleration_is_torque_by_inertia(wheels):
    # 6 N m on 0.5 kg m^2, -1 N m on 0.25 kg m^2; 1 N m on 0.5 kg m^2
    check(wheels, mdp.JointAccL2(), [12.0**2 + 4.0**2, 2.0**2], atol=1e-3)
    check(wheels, mdp.JointAccL2(joints="right"), [4.0**2, 0.0], atol=1e-3)


def test_jerk_is_the_second_difference_of_velocities(wheels):
    # Velocities v(t) = (t^2, -2 t^2) in env steps of 0.02 s: second difference 2 and -4 rad/s per step^2.
    term = mdp.JointJerkL2()
    per_step2 = 0.02**2
    for step in range(1, 5):
        wheels.view.episode_step_E.fill_(step)
        wheels.place(qvel=(step**2, -2.0 * step**2))
        expected = 0.0 if step <= 2 else (2.0 / per_step2) ** 2 + (4.0 / per_step2) ** 2
        torch.testing.assert_close(wheels.read(term, "rewards/jerk"), torch.full((2,), expected))


def test_a_target_is_out_of_reach_beyond_what_speed_and_acceleration_allow(free_body):
    term = mdp.UnreachableTargetL2(
        max_velocity={"left_hip": 5.0, "right_hip": 0.0},
        max_acceleration={"left_hip": 0.0, "right_hip": 100.0},
    )
    # An env step of 20 ms: 0.1 rad by speed, 0.02 rad by acceleration.
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.2, 0.4))
    free_body.view.joint_pos_target_EL.copy_(torch.tensor([[0.25, 0.41], [0.4, 0.4], [0.2, 0.3]]))
    free_body.view.episode_step_E.fill_(1)
    check(free_body, term, [0.0, 0.0, 0.0])
    free_body.view.episode_step_E.fill_(2)
    # The joints have moved on to their targets; what counts is where the step began.
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.4, 0.3))
    check(free_body, term, [0.0, 0.1**2, 0.08**2])


def test_effort_and_force_differ_by_the_gear(wheels):
    check(wheels, mdp.JointEffortL2(), [37.0, 1.0])
    check(wheels, mdp.JointEffortL2(joints="right"), [1.0, 0.0])
    check(wheels, mdp.ActuatorForceL2(), [10.0, 0.25])
    check(wheels, mdp.ActuatorForceL2(actuators="left"), [9.0, 0.25])
    check(wheels, mdp.JointEffortLimits(limits={"left": 4.0, "right": 0.5}), [2.5, 0.0])
    check(wheels, mdp.JointEffortLimits(limits={".*": 1.0}, soft_factor=0.9), [5.1 + 0.1, 0.1])


def test_energy_is_the_power_of_all_joints(wheels):
    # After 20 ms: 0.24 and -0.08 rad/s, 0.04 and 0 rad/s
    check(wheels, mdp.Energy(), [6.0 * 0.24 + 1.0 * 0.08, 1.0 * 0.04])
    check(wheels, mdp.Energy(joints="right"), [0.08, 0.0])
    # A motor that brakes counts as well.
    wheels.place(qvel=(-0.24, -0.08))
    check(wheels, mdp.Energy(), [6.0 * 0.24 + 1.0 * 0.08, 1.0 * 0.24])


@pytest.mark.parametrize("term", [mdp.JointVelLimits, mdp.JointEffortLimits])
def test_limits_must_be_positive_and_complete(free_body, term):
    with pytest.raises(ValueError, match=r"limits\.\.\*=0"):
        term(limits={".*": 0.0})
    with pytest.raises(ValueError, match="soft_factor=1.5"):
        term(limits={".*": 1.0}, soft_factor=1.5)
    with pytest.raises(ValueError, match="limits: 'right_hip' matches no pattern"):
        free_body.read(term(limits={"left.*": 1.0}), "rewards/x")
