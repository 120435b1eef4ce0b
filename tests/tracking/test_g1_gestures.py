"""Random gestures: the ranges that they cover, and that the robot can do one."""

import numpy as np
import pytest

from ksim_rl.tracking.feasibility import feasibility
from ksim_rl.tracking.g1_gestures import ARM, SPEED, gesture
from ksim_rl.tracking.g1_motions import FIGURE, FPS, STAND
from ksim_rl.tracking.g1_repertoire import KINDS
from ksim_rl.tracking.keyframes import eased, perform
from tests.tracking.g1 import g1_model


def held(keys):
    """Return the values of keys."""
    return np.array([value for _, value in keys])


def test_a_seed_names_one_gesture_and_both_arms_move_apart():
    plan = gesture(3)
    assert plan == gesture(3) and plan != gesture(4)
    left = held(plan.joints["left_elbow_joint"])
    assert np.abs(left - held(plan.joints["right_elbow_joint"])).max() > 0.2
    # Rest at both ends, in the default pose.
    for keys in (*plan.joints.values(), plan.lean):
        assert keys[0][1] == keys[-1][1] == 0.0
    assert plan.root_height[0][1] == plan.root_height[-1][1] == STAND
    assert not plan.moves


def test_all_gestures_together_cover_the_ranges_on_both_sides():
    plans = [plan() for plan in KINDS["gesture"].values()]
    for name, (low, high) in ARM.items():
        room = 0.1 * (high - low)
        for side in ("left", "right"):
            all_values = [held(plan.joints[f"{side}_{name}_joint"]) for plan in plans]
            values = np.concatenate(all_values)
            if side == "right" and name.endswith(("roll", "yaw")):
                values = -values
            # The default pose, 0, may lie outside of a range.
            assert min(low, 0.0) <= values.min() < low + room, (side, name)
            assert high - room < values.max() <= high, (side, name)


def test_no_joint_is_faster_than_its_rest_to_rest_way_allows():
    plan = gesture(0)
    time_F = np.arange(0.0, plan.duration_s, 1.0 / FPS)
    for keys in plan.joints.values():
        speed_F = np.gradient(eased(keys, time_F), 1.0 / FPS)
        # A way that rests at both ends is 15/8 times as fast in its middle as in the mean.
        assert np.abs(speed_F).max() <= 15.0 / 8.0 * SPEED + 1e-6


@pytest.mark.full
def test_the_robot_can_do_one_that_stays_where_it_stands():
    model = g1_model()
    qpos_FL, _, planted_FN = perform(model, FIGURE, gesture(0), fps=FPS)
    found = feasibility(model, qpos_FL, FPS, figure=FIGURE, planted_FN=planted_FN)
    assert not found.faults() and planted_FN.all()
    # What was drawn is what the arm does.
    elbow = model.joint("left_elbow_joint").qposadr[0]
    elbow_F = qpos_FL[:, elbow] - model.key_qpos[0][elbow]
    wanted_F = eased(gesture(0).joints["left_elbow_joint"], np.arange(len(qpos_FL)) / FPS)
    assert np.abs(elbow_F - wanted_F).max() < 0.1
