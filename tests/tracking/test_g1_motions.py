"""The motions of G1: what was asked of them, and whether the robot could do them, by sums over its bodies.

The zero-moment point here is made from momenta of all bodies, by the C engine's `mj_subtreeVel`; the one that the
motions are made with comes from inverse dynamics.
"""

import mujoco
import numpy as np
import pytest

from ksim_rl.clips.motion_file import velocities
from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.tracking.dynamics import demand, self_contacts
from ksim_rl.tracking.g1_motions import CLIPS, FIGURE, FPS, made
from ksim_rl.tracking.keyframes import foot_paths
from tests.tracking.g1 import g1_model

# m: half of a sole's length and width, less than its contact capsules' (0.093 and 0.027).
SOLE = np.array((0.09, 0.025))


class Motion:
    def __init__(self, name):
        self.model, self.plan = g1_model(), CLIPS[name].plan()
        with np.load(motion_path(name)) as file:
            self.fps, self.qpos_FL, self.qvel_FM = (
                float(file["fps"]),
                *(file[key].astype(float) for key in ("qpos", "qvel")),
            )
        self.time_F = np.arange(len(self.qpos_FL)) / FPS
        self.paths_FN5, self.planted_FN = foot_paths(self.plan, self.time_F)


@pytest.fixture(scope="module", params=CLIPS)
def motion(request):
    g1_model()
    return Motion(request.param)


def each_frame(motion):
    data = mujoco.MjData(motion.model)
    for qpos, qvel in zip(motion.qpos_FL, motion.qvel_FM, strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_kinematics(motion.model, data)
        mujoco.mj_comPos(motion.model, data)
        mujoco.mj_comVel(motion.model, data)
        yield data


def test_it_lasts_and_is_quick(motion):
    assert motion.fps == FPS
    assert motion.time_F[-1] >= 8.0
    assert np.percentile(np.abs(motion.qvel_FM[:, 6:]), 95.0) > 2.0, (
        "rad/s, of all joints in all frames"
    )


def test_velocities_are_those_of_its_positions(motion):
    assert motion.qvel_FM == pytest.approx(velocities(motion.model, motion.qpos_FL, FPS), abs=2e-3)


def test_joints_stay_inside_their_ranges(motion):
    low, high = motion.model.jnt_range[1:].T
    room = np.minimum(motion.qpos_FL[:, 7:] - low, high - motion.qpos_FL[:, 7:])
    assert room.min() > 0.002


def test_feet_that_stand_do_not_slip_and_touch_the_ground(motion):
    places_FN3 = np.array(
        [[data.site(site).xpos.copy() for site in FIGURE.feet] for data in each_frame(motion)]
    )
    still_FN = motion.planted_FN[:-1] & motion.planted_FN[1:]
    slip_FN = np.linalg.norm(np.diff(places_FN3, axis=0), axis=-1) * FPS
    assert slip_FN[still_FN].max() < 0.01, "m/s"
    assert np.abs(places_FN3[..., 2][motion.planted_FN] - FIGURE.sole_z).max() < 1e-3
    assert places_FN3[..., 2].min() > FIGURE.sole_z - 2e-3


def test_pressure_stays_under_the_soles_that_stand(motion):
    mass, com, push, spin = float(motion.model.body_subtreemass[1]), [], [], []
    for data in each_frame(motion):
        mujoco.mj_subtreeVel(motion.model, data)
        com.append(data.subtree_com[0].copy())
        push.append(mass * data.subtree_linvel[0])
        spin.append(data.subtree_angmom[0].copy())
    com_F3, force_F3, moment_F3 = (
        np.array(com),
        *(np.gradient(np.array(part), 1 / FPS, axis=0) for part in (push, spin)),
    )
    force_F3[:, 2] += mass * 9.81
    # About the point p of the ground: (com - p) x force = moment, horizontally.
    zmp_F2 = com_F3[:, :2] - com_F3[:, 2:] * force_F3[:, :2] / force_F3[:, 2:]
    zmp_F2 += np.stack((-moment_F3[:, 1], moment_F3[:, 0]), axis=-1) / force_F3[:, 2:]
    share_F = force_F3[:, 2] / (mass * 9.81)
    assert share_F.min() > 0.7 and share_F.max() < 1.3, "it neither jumps nor lands hard"
    assert (np.linalg.norm(force_F3[:, :2], axis=-1) / force_F3[:, 2]).max() < 0.3, (
        "the least friction that is drawn"
    )
    for frame, zmp_2 in enumerate(zmp_F2):
        feet = motion.paths_FN5[frame][motion.planted_FN[frame]]
        # On the line between the feet that stand, off it by no more than a sole.
        start, end = feet[0], feet[-1]
        line_2 = end[:2] - start[:2]
        share = np.clip((zmp_2 - start[:2]) @ line_2 / max(line_2 @ line_2, 1e-9), 0.0, 1.0)
        heading = start[3] + share * (end[3] - start[3])
        away_2 = zmp_2 - start[:2] - share * line_2
        ahead, aside = (
            np.array(((np.cos(heading), np.sin(heading)), (-np.sin(heading), np.cos(heading))))
            @ away_2
        )
        assert abs(ahead) < SOLE[0] and abs(aside) < SOLE[1], (frame, ahead, aside)


def test_its_motors_can_do_it(motion):
    asked = demand(
        motion.model, motion.qpos_FL, FPS, feet=FIGURE.feet, planted_FN=motion.planted_FN
    )
    joints = motion.model.actuator_trnid[:, 0]
    torque_FM = np.abs(asked.torque_FM[:, motion.model.jnt_dofadr[joints] - 6])
    assert (torque_FM / motion.model.actuator_forcerange[:, 1]).max() < 0.6


def test_it_does_not_touch_itself(motion):
    assert self_contacts(motion.model, motion.qpos_FL) == []


def test_a_walk_of_two_metres():
    motion = Motion("g1_walk")
    way_2 = motion.qpos_FL[-1, :2] - motion.qpos_FL[0, :2]
    assert way_2 == pytest.approx((2.52, 0.0), abs=0.02)


def test_squats_are_deep():
    motion = Motion("g1_squat")
    knee = int(motion.model.joint("left_knee_joint").qposadr[0])
    assert motion.qpos_FL[:, knee].max() > 1.7
    assert motion.qpos_FL[:, 2].min() < 0.5


def test_a_full_turn():
    motion = Motion("g1_turn")
    w, x, y, z = motion.qpos_FL[:, 3:7].T
    heading_F = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    assert heading_F[-1] - heading_F[0] == pytest.approx(2 * np.pi, abs=0.02)


def test_kicks_stand_on_each_leg_for_two_seconds_and_bring_the_foot_up():
    motion = Motion("g1_kick")
    for foot, site in enumerate(FIGURE.feet):
        alone_F = motion.planted_FN[:, foot] & ~motion.planted_FN[:, 1 - foot]
        assert alone_F.sum() / FPS > 2.0
        assert np.diff(np.flatnonzero(alone_F)).max() == 1, "in one piece"
        assert max(data.site(site).xpos[2] for data in each_frame(motion)) > 0.28


def test_the_files_are_what_the_keyframes_make():
    g1_model()
    qpos_FL = np.load(motion_path("g1_squat"))["qpos"]
    assert made("g1_squat") == pytest.approx(qpos_FL, abs=1e-4)


@pytest.mark.full
@pytest.mark.parametrize("name", [name for name in CLIPS if name != "g1_squat"])
def test_all_files_are_what_the_keyframes_make(name):
    g1_model()
    assert made(name) == pytest.approx(np.load(motion_path(name))["qpos"], abs=1e-4)


def test_files_are_small():
    assert all(motion_path(name).stat().st_size < 150_000 for name in CLIPS)
