"""The numbers of a hidden robot are found, with honest intervals; what its log does not tell is said."""

import numpy as np
import pytest

from ksim_rl.identification.excitation import propose
from ksim_rl.identification.fit import fit
from ksim_rl.identification.held_robot import KINDS, hold
from ksim_rl.identification.joint_log import read_log
from tests.identification import hidden

pytest.importorskip("tabulate", reason="needs the extra: pip install ksim_rl[identify]")
NOISE, COUNT = 5e-4, 2.0 * np.pi / 2**14


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "leg.xml"
    path.write_text(hidden.MODEL)
    return hold(str(path))


def logged(robot, folder, secret, kinds, seconds=6.0):
    """The log of the hidden robot under the commands that are proposed for it, as its encoders count."""
    plan = propose(robot, kinds, seconds=seconds, seed=3)
    pos_TN = hidden.follow(secret, plan.time_T, plan.by_kind)
    noisy_TN = pos_TN + np.random.default_rng(0).normal(0.0, NOISE, pos_TN.shape)
    path = folder / "log.csv"
    path.write_text(hidden.log_text(plan.time_T, plan.by_kind, np.round(noisy_TN / COUNT) * COUNT))
    return read_log(path, robot)


def test_all_numbers_of_a_hidden_robot_are_found(robot, tmp_path):
    secret = hidden.Secret()
    findings = fit(robot, logged(robot, tmp_path, secret, ("pos", "vel", "effort")))
    for place, joint in enumerate(hidden.JOINTS):
        for kind in KINDS:
            true, number = getattr(secret, kind)[place], findings.joints[joint][kind]
            assert number.value == pytest.approx(true, rel=0.05), (joint, kind)
            # The interval is neither far too narrow nor meaningless.
            assert abs(number.value - true) < 3.0 * number.half_width + 0.02 * true, (joint, kind)
            assert number.half_width < 0.1 * true, (joint, kind)
    assert findings.delay_s.value == pytest.approx(secret.delay_s, abs=1e-3)
    # What is left is what the encoders add.
    assert max(findings.unexplained.values()) == pytest.approx(
        np.hypot(NOISE, COUNT / 12**0.5), rel=0.1
    )
    assert not findings.warnings


@pytest.mark.full
def test_positions_alone_tell_the_sum_of_both_dampings_and_no_torque_constant(robot, tmp_path):
    secret = hidden.Secret()
    findings = fit(robot, logged(robot, tmp_path, secret, ("pos",)))
    for place, joint in enumerate(hidden.JOINTS):
        numbers = findings.joints[joint]
        both = secret.damping[place] + secret.servo_damping[place]
        assert numbers["servo_damping"].value == pytest.approx(both, rel=0.05)
        assert "together" in numbers["servo_damping"].remark
        assert not numbers["damping"].is_told and "velocities" in numbers["damping"].remark
        assert (
            not numbers["torque_constant"].is_told
            and "efforts" in numbers["torque_constant"].remark
        )
        assert numbers["stiffness"].value == pytest.approx(secret.stiffness[place], rel=0.05)


@pytest.mark.full
def test_a_motion_without_speed_leaves_the_armature_open(robot, tmp_path):
    # So slow that inertia is little beside friction and the servo, read by a poor encoder.
    time_T = np.arange(3000) / 500.0
    slow_T = 0.1 * np.sin(0.3 * time_T)
    pos_TN = np.stack((slow_T, -0.8 + slow_T), axis=1)
    secret = hidden.Secret()
    read_TN = hidden.follow(secret, time_T, {"pos": pos_TN})
    read_TN = read_TN + np.random.default_rng(0).normal(0.0, 0.05, read_TN.shape)
    path = tmp_path / "slow.csv"
    path.write_text(hidden.log_text(time_T, {"pos": pos_TN}, read_TN))
    findings = fit(robot, read_log(path, robot))
    armature = findings.joints["knee"]["armature"]
    assert not armature.is_told and "faster" in armature.remark


@pytest.mark.full
def test_a_robot_that_moves_otherwise_is_doubted(robot, tmp_path):
    log = logged(robot, tmp_path, hidden.Secret(), ("pos",))
    # The encoder of the knee counts backwards.
    log.pos_TN[:, 1] = -1.6 - log.pos_TN[:, 1]
    findings = fit(robot, log)
    assert any("'knee'" in line and "not explained" in line for line in findings.warnings)
