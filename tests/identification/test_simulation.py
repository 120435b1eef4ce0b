"""The fitted simulation is MuJoCo's C engine: compared with plain `mj_step` in a quarter of its time step."""

import numpy as np
import pytest

from ksim_rl.identification.held_robot import KINDS, hold
from ksim_rl.identification.simulation import Candidate, Simulation, Targets
from tests.identification import hidden


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "leg.xml"
    path.write_text(hidden.MODEL)
    return hold(str(path))


def test_each_candidate_moves_as_its_robot_does(robot):
    time_T = np.arange(1500) / 500.0
    phase = np.array((0.0, 1.0))
    targets = {
        "pos": 0.4 * np.sin(9.0 * time_T[:, None] + phase) + np.array((0.1, -1.0)),
        "vel": 2.0 * np.cos(14.0 * time_T[:, None] + phase),
        "effort": 1.5 * np.sin(5.0 * time_T[:, None] + phase),
    }
    # On the grid of the plain simulation, which holds its commands for a whole step.
    secrets = [hidden.Secret(delay_s=0.012), hidden.Secret(armature=(0.03, 0.02), delay_s=0.0)]
    candidates = []
    for secret in secrets:
        numbers_PN = [getattr(secret, kind) for kind in KINDS]
        candidates.append(Candidate(numbers_NP=np.array(numbers_PN).T, delay_s=secret.delay_s))
    simulation = Simulation(robot, Targets(time_T=time_T, by_kind=targets), num_candidates=2)
    read_T = time_T[::7]
    found_KRN = simulation.positions(candidates, read_T, targets["pos"][0])
    for found_RN, secret in zip(found_KRN, secrets, strict=True):
        true_RN = hidden.follow(secret, time_T, targets)[::7]
        assert np.ptp(true_RN, axis=0).min() > 0.2
        assert found_RN == pytest.approx(true_RN, abs=3e-4)


def test_targets_are_held_and_late():
    targets = Targets(time_T=np.array((0.0, 1.0)), by_kind={"pos": np.array(((2.0,), (4.0,)))})
    # In the middle of the second step of 2 ms the new target arrives, 3 ms late.
    means_SN = targets.of_steps(1.0, 3, 0.003)["pos"]
    assert means_SN[:, 0] == pytest.approx((2.0, 3.0, 4.0))
    # Before the first command it was there already; the last one stays.
    assert targets.of_steps(-1.0, 2, 0.0)["pos"][:, 0] == pytest.approx((2.0, 2.0))
    assert targets.of_steps(5.0, 2, 0.0)["pos"][:, 0] == pytest.approx((4.0, 4.0))
