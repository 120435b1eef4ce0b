"""How feasible a motion is: nothing is wrong with one that is, and a still pose has its mass centre's place."""

import mujoco
import numpy as np
import pytest

from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.tracking.feasibility import feasibility
from ksim_rl.tracking.g1_motions import FIGURE, FPS
from tests.tracking.g1 import g1_model


def test_a_part_of_our_own_kick_is_feasible_also_where_feet_are_told_by_their_soles():
    with np.load(motion_path("g1_kick")) as file:
        qpos_FL = file["qpos"][85:125].astype(float)
    assert feasibility(g1_model(), qpos_FL, FPS, figure=FIGURE).faults() == []


def test_a_still_pose_that_leans_puts_the_pressure_below_the_mass_centre(monkeypatch):
    sole = 0.03
    monkeypatch.setattr("ksim_rl.tracking.feasibility.SOLE", (sole, 0.025))
    model = g1_model()
    qpos_FL = np.tile(model.key_qpos[0], (5, 1))
    qpos_FL[:, model.joint("waist_pitch_joint").qposadr[0]] = 0.5
    for side in ("left", "right"):
        qpos_FL[:, model.joint(f"{side}_shoulder_pitch_joint").qposadr[0]] = -1.6
    data = mujoco.MjData(model)
    data.qpos[:] = qpos_FL[0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    soles_N3 = np.array([data.site(foot).xpos for foot in FIGURE.feet])
    ahead = data.subtree_com[0, 0] - soles_N3[:, 0].mean()
    planted_FN = np.ones((5, 2), bool)
    found = feasibility(model, qpos_FL, FPS, figure=FIGURE, planted_FN=planted_FN)
    assert ahead > sole and found.off_sole == pytest.approx(ahead - sole, abs=2e-4)
    assert (found.least_push, found.most_push) == pytest.approx((1.0, 1.0), abs=1e-3)
    assert found.slip == 0.0 and found.unsupported == 0.0
    assert "outside of the soles" in found.faults()[0]
    qpos_FL[:, 2] += np.array((0.0, 0.0, 0.02, 0.0, 0.0))
    jumped = feasibility(model, qpos_FL, FPS, figure=FIGURE, planted_FN=planted_FN)
    assert jumped.slip == pytest.approx(1.0) and jumped.most_push > 1.3
    in_flight = feasibility(model, qpos_FL, FPS, figure=FIGURE, planted_FN=~planted_FN)
    assert in_flight.unsupported == 1.0 and "no foot stands" in " ".join(in_flight.faults())
