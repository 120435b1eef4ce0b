"""Terms of motion tracking, on the planar walker and its walking clip, against MuJoCo's C engine."""

import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.motions import motion_path
from ksim_rl.scene.state.motion_clock import motion_start_time
from tests.tasks.placed import Placed

CLIP = "walker_walk"
LEGS = "(right|left)_(hip|knee|ankle)"
E = 4


@pytest.fixture(scope="module")
def bench():
    return Placed("walker_track", E)


def at(bench, *times, moved=0.0):
    """Put each env into the motion's state at a time, with the root `moved` m along x."""
    motion = bench.view.motion(CLIP)
    time_E = torch.tensor(times)
    motion_start_time(bench.view, CLIP).copy_(time_E)
    bench.view.episode_step_E.zero_()
    qpos_EL, qvel_EL = motion.sample(time_E)
    qpos_EL[:, 0] += moved
    bench.world.qpos_EL.copy_(qpos_EL)
    bench.world.qvel_EL.copy_(qvel_EL)
    bench.world.refresh()
    bench.driver.refreshed()


def read(bench, term):
    with bench.driver.scope("observations/x"):
        return term(bench.view)


def test_in_the_motion_every_reward_is_one(bench):
    at(bench, 0.0, 1.24, 3.33, 7.9)
    for term in (
        mdp.TrackMotionJointPos(file=CLIP, std=0.1),
        mdp.TrackMotionJointVel(file=CLIP, std=0.1),
        mdp.TrackMotionBodyPos(file=CLIP, std=0.1, bodies=".*_foot"),
        mdp.TrackMotionBodyQuat(file=CLIP, std=0.1, bodies="torso"),
    ):
        torch.testing.assert_close(bench.reward(term), torch.ones(E), atol=2e-3, rtol=0.0)


def test_kernels_of_known_errors(bench):
    at(bench, 0.5, 1.0, 1.5, 2.0, moved=0.3)
    offset = read(bench, mdp.MotionBodyOffset(file=CLIP, bodies="torso"))
    torch.testing.assert_close(
        offset, torch.tensor([[-0.3, 0.0, 0.0]]).expand(E, 3), atol=1e-4, rtol=0.0
    )
    torso = mdp.TrackMotionBodyPos(file=CLIP, std=0.6, bodies="torso")
    torch.testing.assert_close(
        bench.reward(torso), torch.full((E,), math.exp(-0.25)), atol=1e-4, rtol=0.0
    )
    feet = mdp.TrackMotionBodyPos(file=CLIP, std=0.6, bodies=".*_foot")
    torch.testing.assert_close(
        bench.reward(feet), torch.full((E,), math.exp(-0.5)), atol=2e-3, rtol=0.0
    )
    root_x = mdp.TrackMotionJointPos(file=CLIP, std=0.3, joints="root_x")
    torch.testing.assert_close(
        bench.reward(root_x), torch.full((E,), math.exp(-1.0)), atol=1e-4, rtol=0.0
    )

    at(bench, 0.5, 1.0, 1.5, 2.0)
    bench.world.qpos_EL[:, 2] += 0.2
    bench.world.qvel_EL[:, 0] += 0.5
    bench.world.refresh()
    bench.driver.refreshed()
    turned = mdp.TrackMotionBodyQuat(file=CLIP, std=0.2, bodies="torso")
    torch.testing.assert_close(
        bench.reward(turned), torch.full((E,), math.exp(-1.0)), atol=1e-4, rtol=0.0
    )
    fast = mdp.TrackMotionJointVel(file=CLIP, std=0.5)
    torch.testing.assert_close(
        bench.reward(fast), torch.full((E,), math.exp(-1.0)), atol=1e-4, rtol=0.0
    )


def test_poses_of_bodies_on_a_frame_are_the_engines(bench):
    frames = [0, 37, 200, 400]
    data = mujoco.MjData(bench.model)
    with np.load(motion_path(CLIP)) as archive:
        qpos_FL, fps = archive["qpos"], float(archive["fps"])
    pos_EN3, quat_EN4 = bench.view.motion(CLIP).sample_bodies(
        torch.tensor(frames) / fps, slice(1, 5)
    )
    for row, frame in enumerate(frames):
        data.qpos[:] = qpos_FL[frame]
        mujoco.mj_forward(bench.model, data)
        np.testing.assert_allclose(pos_EN3[row], data.xpos[1:5], atol=1e-5)
        np.testing.assert_allclose(
            np.abs((quat_EN4[row].numpy() * data.xquat[1:5]).sum(-1)), 1.0, atol=1e-5
        )


def test_what_the_policy_sees(bench):
    at(bench, 0.0, 0.25, 1.0, 2.5)
    phase = read(bench, mdp.MotionPhase(file=CLIP, cycle_s=1.0))
    torch.testing.assert_close(
        phase, torch.tensor([[0.0, 1], [1, 0], [0, 1], [0, -1]]), atol=1e-5, rtol=0.0
    )
    whole = read(bench, mdp.MotionPhase(file=CLIP))
    torch.testing.assert_close(
        whole[2], torch.tensor([math.sin(math.pi / 4), math.cos(math.pi / 4)])
    )
    joints = read(bench, mdp.MotionJoints(file=CLIP, joints=LEGS))
    legs = bench.view.joints(LEGS)
    own = torch.cat((legs.pos_EL, legs.vel_EL), dim=-1)
    torch.testing.assert_close(joints, own)
    # The walk repeats after a second.
    ahead = read(bench, mdp.MotionJoints(file=CLIP, joints=LEGS, ahead_s=1.0))
    torch.testing.assert_close(ahead[1:, :6], joints[1:, :6], atol=1e-4, rtol=0.0)


def test_episodes_end_with_the_motion_or_away_from_it(bench):
    at(bench, 0.0, 4.0, 7.9, 8.0)
    assert read(bench, mdp.MotionFinished(file=CLIP)).tolist() == [False, False, False, True]
    at(bench, 0.5, 1.0, 1.5, 2.0, moved=0.39)
    strayed = mdp.FarFromMotion(file=CLIP, bodies="torso", distance=0.4)
    assert not read(bench, strayed).any()
    at(bench, 0.5, 1.0, 1.5, 2.0, moved=0.41)
    assert read(bench, strayed).all()


def test_time_in_the_motion_runs_with_the_episode(bench):
    env = bench.env
    root = env.reset()
    start_E = motion_start_time(bench.view, CLIP).clone()
    assert start_E.unique().numel() == E, "random phases"
    assert start_E.min() >= 0.0 and start_E.max() <= 0.9 * 8.0
    torch.testing.assert_close(bench.world.qpos_EL, bench.view.motion(CLIP).sample(start_E)[0])
    root["action"] = torch.zeros(E, 6)
    next_E = env.step(root)["next"]
    expected = torch.sin(2.0 * math.pi * (start_E + env.step_dt))
    torch.testing.assert_close(next_E["obs", "phase"][:, 0], expected, atol=1e-4, rtol=0.0)


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"std=0\.0"):
        mdp.TrackMotionJointPos(file=CLIP, std=0.0)
    with pytest.raises(ValueError, match=r"cycle_s=-1\.0"):
        mdp.MotionPhase(file=CLIP, cycle_s=-1.0)
    with pytest.raises(ValueError, match=r"distance=0\.0"):
        mdp.FarFromMotion(file=CLIP, bodies="torso", distance=0.0)


def test_the_distance_of_a_pose_is_to_the_nearest_frame_of_the_whole_motion(bench):
    at(bench, 0.0, 1.24, 3.33, 7.9)
    mj_model = bench.world.mj_model
    legs = bench.view.joints(LEGS).names
    places = [int(mj_model.joint(name).qposadr[0]) for name in legs]
    bench.world.qpos_EL[:, places[0]] += 0.4
    bench.world.refresh()
    bench.driver.refreshed()
    frames_FL = np.load(motion_path(CLIP))["qpos"][:, places]
    expected = []
    for qpos_L in bench.world.qpos_EL.double().numpy():
        errors_FL = frames_FL - qpos_L[places]
        expected.append(np.sqrt((errors_FL**2).mean(1)).min())
    found = read(bench, mdp.PoseDistance(file=CLIP, joints=LEGS))
    assert min(expected) > 0.02
    torch.testing.assert_close(found, torch.tensor(expected).float(), atol=1e-4, rtol=0.0)


def test_a_pose_of_the_motion_has_no_distance(bench):
    at(bench, 0.0, 1.0, 3.0, 7.0)
    mj_model = bench.world.mj_model
    places = [int(mj_model.joint(name).qposadr[0]) for name in bench.view.joints(LEGS).names]
    # Frames of the file, of which there are many.
    frames_FL = np.load(motion_path(CLIP))["qpos"][:, places]
    assert len(frames_FL) > 100
    bench.world.qpos_EL[:, places] = torch.tensor(frames_FL[[0, 20, 50, 90]]).float()
    bench.world.refresh()
    bench.driver.refreshed()
    found = read(bench, mdp.PoseDistance(file=CLIP, joints=LEGS))
    assert found.max() < 1e-6
