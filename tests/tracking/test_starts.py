"""Where episodes begin: errors of the start in their ranges, and more starts where failures were."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.scene.state.motion_clock import motion_start_time
from ksim_rl.tracking.starts import FailedParts, StartInMotion, part_weights, parts_of
from ksim_rl.tracking.tasks import track_cfg
from tests.tracking.g1 import g1_model

CLIP = "g1_walk"


def built(num_envs, *, curriculum=True, **changes):
    g1_model()
    cfg = track_cfg(CLIP)
    start = dataclasses.replace(cfg.events["start"], **changes)
    scene = dataclasses.replace(cfg.scene, num_envs=num_envs)
    cfg = dataclasses.replace(cfg, scene=scene, events={"start": start}, seed=3)
    if not curriculum:
        cfg = dataclasses.replace(cfg, curriculum={})
    return envs.build(cfg).base_env


def weights_of(view):
    return part_weights(view, CLIP, parts_of(view, CLIP, 1.0))


def test_errors_of_the_start_keep_their_ranges():
    env = built(200, start_range=(0.25, 0.75), part_s=None, curriculum=False)
    env.reset()
    view, motion, start = env.view, env.view.motion(CLIP), env.cfg.events["start"]
    start_E = motion_start_time(view, CLIP)
    assert 0.25 * motion.duration_s <= start_E.min() < 0.3 * motion.duration_s
    assert 0.7 * motion.duration_s < start_E.max() <= 0.75 * motion.duration_s
    qpos_EL, qvel_EL = motion.sample(start_E)
    away_E3 = view.root_pos_EL - qpos_EL[:, :3]
    for axis, name in enumerate("xyz"):
        low, high = start.pose_range[name]
        assert (
            low - 1e-5 <= away_E3[:, axis].min() < 0.8 * low
            and 0.8 * high < away_E3[:, axis].max() <= high + 1e-5
        )
    kick_E3 = view.root_lin_vel_w_EL - qvel_EL[:, :3]
    assert (
        kick_E3.abs().amax(0) <= torch.tensor((0.5, 0.5, 0.2)) + 1e-4
    ).all() and kick_E3.abs().max() > 0.4
    turn, world = np.empty(4), np.empty(3)
    for row in range(20):
        mujoco.mju_negQuat(turn, qpos_EL[row, 3:7].double().numpy())
        mujoco.mju_mulQuat(turn, view.root_quat_EL[row].double().numpy(), turn.copy())
        # Turned in the world by roll, pitch and yaw of at most 0.1, 0.1 and 0.2 rad.
        assert 2.0 * np.arccos(min(1.0, abs(turn[0]))) < np.sqrt(0.1**2 + 0.1**2 + 0.2**2) + 1e-3
        mujoco.mju_rotVecQuat(
            world, qvel_EL[row, 3:6].double().numpy(), qpos_EL[row, 3:7].double().numpy()
        )
        spin = view.root_ang_vel_w_EL[row].numpy() - world
        assert (np.abs(spin) < np.array((0.52, 0.52, 0.78)) + 1e-4).all()
    off_EL = (view.joint_pos_EL - qpos_EL[:, 7:]).abs()
    assert off_EL.max() <= 0.1 + 1e-5 and off_EL.mean() == pytest.approx(0.05, abs=0.005)
    assert torch.equal(view.joint_vel_EL, qvel_EL[:, 6:])


def test_failures_in_one_part_bring_more_starts_there():
    env = built(256)
    view, motion = env.view, env.view.motion(CLIP)
    term = FailedParts(file=CLIP, part_s=1.0, uniform=0.5, memory=10.0)
    with env.driver.scope("curriculum/failed_parts"):
        everyone_E = torch.ones(256, dtype=torch.bool)
        motion_start_time(view, CLIP).fill_(4.2)
        view.episode_step_E.fill_(20)  # ended at 4.6 s
        view.terminated_E.fill_(True)
        before_B = weights_of(view).clone()
        term(view, torch.zeros(256, dtype=torch.bool))
        assert torch.equal(weights_of(view), before_B), "nobody ended"
        for _ in range(30):
            level = term(view, everyone_E)
    weights_B = weights_of(view)
    part = int(4.6 / motion.duration_s * 9)
    assert weights_B.sum().item() == pytest.approx(1.0)
    assert weights_B.argmax() == part and level.item() == pytest.approx(0.5 + 0.5 / 9, abs=0.02)
    with env.driver.scope("events/start", view.reset_count_E):
        clip_E, share_E = env.cfg.events["start"].draw_start(view)
    assert clip_E is None, "there is one clip"
    begins = np.histogram(share_E.numpy(), bins=9, range=(0.0, 1.0))[0] / 256
    assert begins[part] == pytest.approx(weights_B[part].item(), abs=0.1)
    assert (begins > 0.01).all(), "half of the starts are spread evenly"


def test_who_has_not_failed_counts_for_nothing():
    env = built(8)
    view = env.view
    term = FailedParts(file=CLIP, memory=10.0)
    with env.driver.scope("curriculum/failed_parts"):
        view.episode_step_E.fill_(20)
        view.terminated_E.fill_(False)
        for _ in range(5):
            term(view, torch.ones(8, dtype=torch.bool))
    weights_B = weights_of(view)
    assert weights_B == pytest.approx(torch.full((9,), 1.0 / 9))


def test_ranges_are_checked():
    with pytest.raises(ValueError, match="joint_range"):
        StartInMotion(file=CLIP, joint_range=-0.1)


def test_a_range_of_starts_that_the_curriculum_would_replace_is_refused():
    with pytest.raises(ValueError, match=r"start_range=\(0.0, 0.5\) with part_s=1: .*part_s=null"):
        StartInMotion(file="x.npz", start_range=(0.0, 0.5), part_s=1.0)
