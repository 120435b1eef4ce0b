"""Observations, rewards and terminations of tracking at injected states, against NumPy and MuJoCo's C engine."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.state.motion_clock import motion_start_time
from ksim_rl.tracking import terms
from ksim_rl.tracking.reference import motion_velocities
from ksim_rl.tracking.tasks import ANCHOR, BODIES, ENDS
from tests.tasks.placed import Placed
from tests.tracking.g1 import g1_model

CLIP, E = "g1_walk", 4
FRAMES = (0, 130, 211, 400)
OF = {"file": CLIP, "anchor": ANCHOR}
OF_BODIES = {"file": CLIP, "bodies": BODIES}


class Bodies:
    """Poses and velocities of bodies in a state, by the C engine."""

    def __init__(self, model, qpos, qvel):
        data, moving = mujoco.MjData(model), np.empty(6)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        ids = [model.body(body).id for body in BODIES]
        self.pos_N3, self.quat_N4 = data.xpos[ids].copy(), data.xquat[ids].copy()
        self.mat_N33 = data.xmat[ids].reshape(-1, 3, 3).copy()
        velocities = []
        for body in ids:
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, moving, 0)
            velocities.append(moving.copy())
        self.ang_vel_N3, self.lin_vel_N3 = np.split(np.array(velocities), 2, axis=-1)


def angles(a_N33, b_N33):
    cosine = (np.einsum("nij,nij->n", a_N33, b_N33) - 1.0) / 2.0
    return np.arccos(np.clip(cosine, -1.0, 1.0))


@pytest.fixture(scope="module")
def bench():
    g1_model()
    return Placed("g1_track_walk", E)


@pytest.fixture(scope="module")
def states(bench):
    """The robot is off the motion by a drawn error in each env; returns (own, reference) by env."""
    view, motion, draw = bench.view, bench.view.motion(CLIP), np.random.default_rng(0)
    motion_start_time(view, CLIP).copy_(torch.tensor(FRAMES) / motion.fps)
    view.episode_step_E.zero_()
    qpos_FL, qvel_FM = motion.qpos_FL.double().numpy(), motion.qvel_FL.double().numpy()
    found = []
    for env, frame in enumerate(FRAMES):
        qpos, qvel = qpos_FL[frame].copy(), qvel_FM[frame] + draw.uniform(-0.5, 0.5, bench.model.nv)
        qpos[:3] += draw.uniform(-0.15, 0.15, 3)
        turn = np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, np.array((0.0, 0.6, 0.8)), draw.uniform(-0.5, 0.5))
        mujoco.mju_mulQuat(qpos[3:7], turn, qpos[3:7].copy())
        qpos[7:] += draw.uniform(-0.1, 0.1, 29)
        bench.world.qpos_EL[env], bench.world.qvel_EL[env] = torch.tensor(qpos), torch.tensor(qvel)
        own = Bodies(bench.model, qpos, qvel)
        found.append((own, Bodies(bench.model, qpos_FL[frame], qvel_FM[frame])))
    bench.world.refresh()
    bench.driver.refreshed()
    return found


def read(bench, term):
    with bench.driver.scope("observations/x"):
        return term(bench.view).double().numpy()


AT = BODIES.index(ANCHOR)


def aligned(own, wanted):
    """The motion turned about the vertical and moved so that its anchor is over the robot's, in plain NumPy."""
    between_33 = own.mat_N33[AT] @ wanted.mat_N33[AT].T
    heading = np.arctan2(between_33[1, 0], between_33[0, 0])
    turn_33 = np.array(
        ((np.cos(heading), -np.sin(heading), 0), (np.sin(heading), np.cos(heading), 0), (0, 0, 1.0))
    )
    place_3 = np.array((*own.pos_N3[AT, :2], wanted.pos_N3[AT, 2]))
    return place_3 + (wanted.pos_N3 - wanted.pos_N3[AT]) @ turn_33.T, turn_33 @ wanted.mat_N33


def test_observations_of_the_anchor(bench, states):
    pos_E3 = read(bench, terms.MotionAnchorPos(**OF))
    axes_E6 = read(bench, terms.MotionAnchorAxes(**OF))
    for env, (own, wanted) in enumerate(states):
        expected = own.mat_N33[AT].T @ (wanted.pos_N3[AT] - own.pos_N3[AT])
        assert pos_E3[env] == pytest.approx(expected, abs=1e-5)
        assert axes_E6[env] == pytest.approx(
            (own.mat_N33[AT].T @ wanted.mat_N33[AT])[:, :2].T.ravel(), abs=1e-5
        )


def test_observations_of_bodies(bench, states):
    pos_EL = read(bench, terms.BodiesFromAnchor(anchor=ANCHOR, bodies=BODIES))
    axes_EL = read(bench, terms.BodiesFromAnchor(anchor=ANCHOR, bodies=BODIES, part="axes"))
    for env, (own, _) in enumerate(states):
        assert pos_EL[env] == pytest.approx(
            ((own.pos_N3 - own.pos_N3[AT]) @ own.mat_N33[AT]).ravel(), abs=1e-5
        )
        turned = own.mat_N33[AT].T @ own.mat_N33
        assert axes_EL[env] == pytest.approx(turned[:, :, :2].transpose(0, 2, 1).ravel(), abs=1e-5)


def test_the_reference_is_what_joints_do_in_the_motion(bench, states):
    motion = bench.view.motion(CLIP)
    seen_EL = read(bench, mdp.MotionJoints(file=CLIP, joints=".*"))
    frames = torch.tensor(FRAMES)
    expected_EL = torch.cat((motion.joint_pos_FL[frames], motion.joint_vel_FL[frames]), dim=-1)
    assert seen_EL == pytest.approx(expected_EL.numpy(), abs=1e-4)


def test_velocities_of_the_motion(bench, states):
    lin_vel_EN3, ang_vel_EN3 = motion_velocities(bench.view, CLIP, BODIES)
    for env, (_, wanted) in enumerate(states):
        assert lin_vel_EN3[env].numpy() == pytest.approx(wanted.lin_vel_N3, abs=1e-3)
        assert ang_vel_EN3[env].numpy() == pytest.approx(wanted.ang_vel_N3, abs=1e-3)


def test_rewards(bench, states):
    rated = {
        "anchor_pos": read(bench, terms.TrackAnchorPos(std=0.3, **OF)),
        "anchor_quat": read(bench, terms.TrackAnchorQuat(std=0.4, **OF)),
        "body_pos": read(bench, terms.TrackAlignedPos(std=0.3, anchor=ANCHOR, **OF_BODIES)),
        "body_quat": read(bench, terms.TrackAlignedQuat(std=0.4, anchor=ANCHOR, **OF_BODIES)),
        "lin_vel": read(bench, terms.TrackBodyLinVel(std=1.0, **OF_BODIES)),
        "ang_vel": read(bench, terms.TrackBodyAngVel(std=3.14, **OF_BODIES)),
    }
    for env, (own, wanted) in enumerate(states):
        pos_N3, mat_N33 = aligned(own, wanted)
        squares = {
            "anchor_pos": ((own.pos_N3[AT] - wanted.pos_N3[AT]) ** 2).sum() / 0.3**2,
            "anchor_quat": angles(own.mat_N33[[AT]], wanted.mat_N33[[AT]])[0] ** 2 / 0.4**2,
            "body_pos": ((own.pos_N3 - pos_N3) ** 2).sum(-1).mean() / 0.3**2,
            "body_quat": (angles(own.mat_N33, mat_N33) ** 2).mean() / 0.4**2,
            "lin_vel": ((own.lin_vel_N3 - wanted.lin_vel_N3) ** 2).sum(-1).mean(),
            "ang_vel": ((own.ang_vel_N3 - wanted.ang_vel_N3) ** 2).sum(-1).mean() / 3.14**2,
        }
        for name, square in squares.items():
            assert rated[name][env] == pytest.approx(np.exp(-square), abs=2e-4), name
            assert 1e-3 < rated[name][env] < 0.999, "the state says something"


def test_errors(bench, states):
    error_E = read(bench, terms.BodyPosError(anchor=ANCHOR, **OF_BODIES))
    drift_E = read(bench, terms.BodyDrift(**OF_BODIES))
    for env, (own, wanted) in enumerate(states):
        pos_N3, _ = aligned(own, wanted)
        assert error_E[env] == pytest.approx(
            np.linalg.norm(own.pos_N3 - pos_N3, axis=-1).mean(), abs=1e-5
        )
        assert drift_E[env] == pytest.approx(
            np.linalg.norm(own.pos_N3 - wanted.pos_N3, axis=-1).mean(), abs=1e-5
        )


def test_limits_end_an_episode_just_beyond_them(bench, states):
    ends = [BODIES.index(body) for body in ENDS]
    for env, (own, wanted) in enumerate(states):
        off = np.abs(own.pos_N3[ends, 2] - wanted.pos_N3[ends, 2]).max()
        for distance, expected in ((off - 1e-4, True), (off + 1e-4, False)):
            ended_E = read(bench, terms.OffHeight(file=CLIP, bodies=ENDS, distance=distance))
            assert bool(ended_E[env]) is expected
        tilt = abs(own.mat_N33[AT, 2, 2] - wanted.mat_N33[AT, 2, 2])
        for limit, expected in ((tilt - 1e-4, True), (tilt + 1e-4, False)):
            assert bool(read(bench, terms.OffUpright(limit=limit, **OF))[env]) is expected


def test_actions_move_targets_about_the_motion_of_the_next_step(bench, states):
    names = bench.view.joints().names
    term = terms.JointPositionAroundMotion(file=CLIP, joints=names, scale=0.5)
    action_EL = torch.linspace(-1.0, 1.0, 29).expand(E, 29)
    with bench.driver.scope("actions/x"):
        term(bench.view, action_EL)
    motion = bench.view.motion(CLIP)
    next_EL = motion.joint_pos_FL[torch.tensor(FRAMES) + 1]
    wrong_EL = bench.view.default_joint_pos_EL - bench.view.default_qpos_L[7:]
    assert 0.001 < wrong_EL.abs().max() <= 0.0101, "the drawn error of the default pose"
    torch.testing.assert_close(
        bench.view.joint_pos_target_EL, next_EL + wrong_EL + 0.5 * action_EL, atol=1e-4, rtol=0.0
    )
