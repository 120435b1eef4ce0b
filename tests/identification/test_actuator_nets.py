"""A network learns MuJoCo's DC motor better than a law of two gains can, and `MLPActuator` computes what was fitted."""

import dataclasses

import numpy as np
import pytest
import torch
from safetensors.torch import load

from ksim_rl.identification.actuator_nets import fit_nets
from ksim_rl.identification.held_robot import hold
from ksim_rl.identification.joint_log import JointLog
from ksim_rl.identification.simulation import Targets
from tests.identification import hidden, hidden_motor
from tests.scene.actuators.chain import TIMESTEP, ChainBench

SECONDS = 12.0
NOISE, COUNT, EFFORT_NOISE = 5e-4, 2.0 * np.pi / 2**14, 0.1


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "leg.xml"
    path.write_text(hidden.MODEL)
    return hold(str(path))


@pytest.fixture(scope="module")
def truth():
    """Times, targets, true positions and true efforts."""
    time_T, asked_TN = hidden_motor.commands(SECONDS)
    return time_T, asked_TN, *hidden_motor.follow(hidden_motor.SecretMotor(), time_T, asked_TN)


def logged(truth, *, effort_TN=None):
    time_T, asked_TN, pos_TN, true_TN = truth
    rng = np.random.default_rng(1)
    read_TN = np.round((pos_TN + rng.normal(0.0, NOISE, pos_TN.shape)) / COUNT) * COUNT
    if effort_TN is None:
        effort_TN = true_TN + rng.normal(0.0, EFFORT_NOISE, true_TN.shape)
    targets = Targets(time_T=time_T, by_kind={"pos": asked_TN})
    return JointLog(time_T=time_T, pos_TN=read_TN, targets=targets, effort_TN=effort_TN)


@pytest.fixture(scope="module")
def learned(robot, truth):
    (found,) = fit_nets(robot, logged(truth), timestep=TIMESTEP, num_steps=600)
    return found


def test_a_motor_is_learned(learned):
    assert [joint.name for joint in learned.joints] == list(hidden.JOINTS)
    # Well nearer than the best gains with the best delay, in seconds that neither has seen.
    assert 2.5 * learned.error < learned.pd_error and not learned.doubt
    assert learned.held_out_s == pytest.approx(0.2 * SECONDS, abs=0.1)


@pytest.mark.full
def test_a_motor_is_simulated_as_it_was_learned(learned, truth, tmp_path):
    path = tmp_path / "motor.safetensors"
    path.write_bytes(learned.file)
    entry = learned.entry(path)
    assert entry.effort_limit == 15.0 and entry.armature == 0.01
    time_T, asked_TN, pos_TN, effort_TN = truth
    vel_T = np.gradient(pos_TN[:, 0], time_T)
    bench = ChainBench(dataclasses.replace(entry, joints="elbow"), num_envs=1)
    said = []
    start = len(time_T) - 600
    for line in range(start, start + 200):
        bench.move("elbow", pos=pos_TN[line, 0], vel=vel_T[line])
        bench.view.write_joint_pos_target(("elbow",), torch.full((1, 1), asked_TN[line, 0]))
        said.append(float(bench.efforts("elbow")))
    # The first steps know no past.
    true_T = effort_TN[start + 20 : start + 200, 0]
    away_T = np.array(said)[20:] - true_T
    assert np.sqrt(np.mean(away_T**2)) < 0.2 * np.sqrt(np.mean(true_T**2))


def test_a_network_of_noise_is_doubted(robot, truth):
    noise_TN = np.random.default_rng(2).normal(0.0, 2.0, truth[1].shape)
    (found,) = fit_nets(robot, logged(truth, effort_TN=noise_TN), timestep=0.005, num_steps=100)
    assert "does not explain" in found.doubt


def test_a_seed_gives_one_network(robot, truth):
    nets = []
    for seed in (0, 0, 1):
        (found,) = fit_nets(robot, logged(truth), timestep=0.005, seed=seed, num_steps=20)
        nets.append(load(found.file)["0.weight"])
    assert torch.equal(nets[0], nets[1]) and not torch.equal(nets[0], nets[2])


def test_a_motor_of_two_gains_needs_no_network(robot, truth):
    time_T, asked_TN, pos_TN, _ = truth
    vel_TN = np.gradient(pos_TN, time_T, axis=0)
    effort_TN = 20.0 * (asked_TN - pos_TN) - 0.6 * vel_TN
    (found,) = fit_nets(robot, logged(truth, effort_TN=effort_TN), timestep=0.005, num_steps=300)
    assert found.pd_error < 0.05 and "no better than a proportional-derivative law" in found.doubt


REFUSED = {
    "no efforts": ({"effort_TN": None}, {}, "no column 'hip.effort' of a measured effort"),
    "no positions": ({}, {"pos": None}, "no commanded positions"),
    "other commands": ({}, {"vel": 1.0}, "commands of kind 'vel', which no network sees"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_logs_that_lack_something_are_refused(robot, truth, case):
    parts, kinds, words = REFUSED[case]
    log = logged(truth)
    by_kind = dict(log.targets.by_kind)
    for kind, factor in kinds.items():
        by_kind.pop(kind, None)
        if factor is not None:
            by_kind[kind] = factor * truth[1]
    targets = Targets(time_T=log.time_T, by_kind=by_kind)
    log = dataclasses.replace(log, targets=targets, **parts)
    with pytest.raises(ValueError, match=words):
        fit_nets(robot, log, timestep=0.005)


def test_a_log_that_is_too_slow_is_refused(robot, truth):
    with pytest.raises(ValueError, match=r"a line each 0.002 s, and physics steps are 0.001 s"):
        fit_nets(robot, logged(truth), timestep=0.001)
