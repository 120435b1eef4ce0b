"""One policy for many motions: what is read of each clip, where episodes begin, who is held out, and trials by clip."""

import dataclasses
import shutil

import mujoco
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from ksim_rl import conf, envs
from ksim_rl.scene.motions import MotionSet, contents, load_motion, motion_path
from ksim_rl.scene.motions.motion_set import load_set
from ksim_rl.scene.state.motion_clock import motion_clip, motion_start_time
from ksim_rl.tracking.starts import FailedParts, part_weights, parts_of
from ksim_rl.tracking.tasks import SET, track_cfg, track_set_cfg
from ksim_rl.tracking.trials import run_trials
from tests.tracking.g1 import g1_model

FRAMES = {"g1_kick": 31, "g1_squat": 14, "g1_turn": 24, "g1_walk": 19}
# The first one, which episodes follow before any reset has drawn another.
HELD_OUT = "g1_kick"
PART_S = 0.2
E = 48


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The beginnings of the four motions, of different lengths."""
    g1_model()
    path = tmp_path_factory.mktemp("clips")
    for name, frames in FRAMES.items():
        with np.load(motion_path(name)) as file:
            arrays = {key: file[key] for key in file.files}
        cut = {key: arrays[key][100 : 100 + frames] for key in ("qpos", "qvel")}
        np.savez(path / f"{name}.npz", **{**arrays, **cut})
    return path


def cfg_of(folder, num_envs=E):
    cfg = track_set_cfg()
    motions = {SET: MotionSet(sources=(str(folder),), held_out=(HELD_OUT,))}
    scene = dataclasses.replace(cfg.scene, motions=motions, num_envs=num_envs)
    start = dataclasses.replace(cfg.events["start"], part_s=PART_S)
    return dataclasses.replace(
        cfg,
        scene=scene,
        # The engine that compiles nothing.
        sim=dataclasses.replace(cfg.sim, engine="c"),
        events={**cfg.events, "start": start},
        curriculum={"failed_parts": FailedParts(file=SET, part_s=PART_S, memory=4.0)},
        seed=5,
    )


@pytest.fixture(scope="module")
def env(folder):
    return envs.build(cfg_of(folder)).base_env


def test_each_env_reads_its_own_clip(env, folder):
    motion = env.view.motion(SET)
    assert motion.names == tuple(FRAMES) and motion.held_out == (True, False, False, False)
    draw = np.random.default_rng(0)
    clip_E = torch.tensor(draw.integers(0, 4, E))
    # Before the start and beyond the end of each clip, too, where the next clip lies behind it.
    time_E = torch.tensor(draw.uniform(-0.1, 1.0, E), dtype=torch.float32)
    bodies = env.view.bodies(".*_elbow_link").index
    joints = slice(3, 9)
    qpos_EL, qvel_EL = motion.sample(time_E, clip_E)
    pos_EL, vel_EL = motion.sample_joints(time_E, joints, clip_E)
    body_EN3, body_EN4 = motion.sample_bodies(time_E, bodies, clip_E)
    model = env.world.mj_model
    data = mujoco.MjData(model)
    for row, clip in enumerate(clip_E.tolist()):
        name = motion.names[clip]
        alone = load_motion(folder / f"{name}.npz", model, torch.device("cpu"))
        one_E = time_E[row : row + 1]
        assert torch.equal(
            torch.cat(alone.sample(one_E), -1), torch.cat((qpos_EL, qvel_EL), -1)[row : row + 1]
        )
        assert torch.equal(
            torch.cat(alone.sample_joints(one_E, joints), -1),
            torch.cat((pos_EL, vel_EL), -1)[row : row + 1],
        )
        own_N3, own_N4 = alone.sample_bodies(one_E, bodies)
        assert torch.equal(own_N3[0], body_EN3[row]) and torch.equal(own_N4[0], body_EN4[row])
        # Before its start a clip stays in its first frame, beyond its end in the last: MuJoCo knows where bodies are.
        with np.load(folder / f"{name}.npz") as file:
            frame = np.clip(time_E[row].item() * 50.0, 0, FRAMES[name] - 1)
            if frame not in (0, FRAMES[name] - 1):
                continue
            data.qpos[:] = file["qpos"][int(frame)]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(
            body_EN3[row], data.xpos[list(env.view.bodies(".*_elbow_link").ids)], atol=1e-5
        )


def test_no_episode_of_training_begins_in_a_held_out_clip(env):
    env.reset()
    clip_E = motion_clip(env.view, SET)
    found = np.bincount(clip_E.numpy(), minlength=4)
    assert found[0] == 0 and (found[1:] > 8).all()
    # Nor where no curriculum runs.
    with env.driver.scope("events/start", env.view.reset_count_E):
        drawn = np.bincount(env.cfg.events["start"].draw_clip(env.view).numpy(), minlength=4)
    assert drawn[0] == 0 and (drawn[1:] > 8).all()
    start_E = motion_start_time(env.view, SET)
    ends = torch.tensor([(count - 1) / 50.0 for count in FRAMES.values()])
    assert (start_E <= ends[clip_E]).all() and (start_E > 0.6 * ends[clip_E]).any()
    # An episode ends with its own clip, whatever is behind it in the table.
    left_E = ends[clip_E] - start_E
    env.view.episode_step_E.copy_((left_E / 0.02).floor().long() - 1)
    env.driver.changed()
    finished = env.cfg.terminations["finished"]
    assert not finished(env.view).any()
    env.view.episode_step_E.add_(2)
    env.driver.changed()
    assert finished(env.view).all()


def test_starts_follow_failures_by_clip_and_by_second(env):
    view = env.view
    env.reset()
    parts = parts_of(view, SET, PART_S)
    lengths = [(count - 1) / 50.0 for count in FRAMES.values()]
    counts = [int(np.ceil(length / PART_S - 1e-6)) for length in lengths]
    counts[0] = 0
    assert len(parts) == sum(counts)
    with pytest.raises(ValueError, match="part_s=0.3 of motion clips, and 0.2 elsewhere"):
        parts_of(view, SET, 0.3)
    term = env.cfg.curriculum["failed_parts"]
    view.episode_step_E.fill_(2)
    view.terminated_E.copy_(torch.arange(E) % 3 == 0)
    env.driver.changed()
    mask_E = torch.arange(E) % 2 == 0
    failed_B = np.ones(len(parts))
    clip_E = motion_clip(view, SET).tolist()
    start_E = motion_start_time(view, SET).tolist()
    with env.driver.scope("curriculum/failed_parts"):
        failed_now_B = view.shared("failed_B", [1.0] * len(parts))
        failed_now_B.fill_(1.0)
        level = term(view, mask_E)
    # The same in a loop over envs.
    seen_B = np.zeros(len(parts))
    for row in range(E):
        if row % 6:
            continue
        clip = clip_E[row]
        place = min(int((start_E[row] + 0.04) / lengths[clip] * counts[clip]), counts[clip] - 1)
        seen_B[sum(counts[:clip]) + place] += 1.0
    failed_B += (seen_B - failed_B) / 4.0
    chance_B = 0.5 / len(parts) + 0.5 * failed_B / failed_B.sum()
    np.testing.assert_allclose(part_weights(view, SET, parts), chance_B, rtol=1e-5)
    assert level.item() == pytest.approx(chance_B.max(), rel=1e-5) and seen_B.max() >= 2
    # Where all failures were, half of the starts are.
    weights_B = part_weights(view, SET, parts)
    kept_B = weights_B.clone()
    weights_B.copy_(torch.eye(len(parts))[counts[1] + 1])
    with env.driver.scope("events/start", view.reset_count_E):
        drawn_E, share_E = env.cfg.events["start"].draw_start(view)
    weights_B.copy_(kept_B)
    # The second part of the third clip.
    assert (drawn_E == 2).all()
    assert ((share_E >= 1 / counts[2]) & (share_E <= 2 / counts[2])).all()


def test_parts_that_no_start_draws_are_refused(env):
    term = FailedParts(file="g1_walk")
    with (
        env.driver.scope("curriculum/other"),
        pytest.raises(ValueError, match="FailedParts of motion g1_walk: no StartInMotion of it"),
    ):
        term(env.view, torch.ones(E, dtype=torch.bool))


def test_a_set_that_no_term_reads_is_refused():
    cfg = envs.make_cfg("cartpole_balance")
    motions = {"clips": MotionSet(sources=("walker_walk",))}
    scene = dataclasses.replace(cfg.scene, motions=motions, num_envs=1)
    sim = dataclasses.replace(cfg.sim, engine="c")
    with pytest.raises(ValueError, match="scene.motions.clips: no term reads this set"):
        envs.build(dataclasses.replace(cfg, scene=scene, sim=sim))


def test_a_file_is_read_once_for_its_hash_and_its_frames(folder, env, monkeypatch):
    motions = MotionSet(sources=(str(folder),))
    read = []
    whole = contents.read_bytes
    monkeypatch.setattr(
        contents, "read_bytes", lambda path, **how: read.append(path.stem) or whole(path, **how)
    )
    # The env has read all four; that they are hashed now reads nothing.
    motions.sha256()
    assert read == []
    copy = folder.parent / "copied"
    shutil.copytree(folder, copy)
    again = MotionSet(sources=(str(copy),))
    assert again.sha256() == motions.sha256()
    load_set(again, env.world.mj_model, torch.device("cpu"))
    assert read == list(FRAMES)
    # Frames are not kept: who asks for them again reads them again.
    load_set(again, env.world.mj_model, torch.device("cpu"))
    assert read == 2 * list(FRAMES)


def test_a_policy_sees_the_motion_ahead(env):
    term = env.cfg.observations["actor"].terms["reference"].term
    env.reset()
    with env.driver.scope("observations/x"):
        seen_EL = term(env.view)
    motion = env.view.motion(SET)
    start_E = motion_start_time(env.view, SET)
    joints = env.view.joints(term.joints).index
    wanted = []
    for ahead_s in (0.0, 0.1, 0.3):
        wanted += motion.sample_joints(start_E + ahead_s, joints, motion_clip(env.view, SET))
    assert torch.equal(seen_EL, torch.cat(wanted, -1))
    with pytest.raises(ValueError, match="ahead_s=.*: name one moment or more"):
        dataclasses.replace(term, ahead_s=())


def still():
    return TensorDictModule(
        lambda actor_EL: torch.zeros(*actor_EL.shape[:-1], 29), ["actor"], ["action"]
    )


def far(task):
    ends = {
        name: dataclasses.replace(term, distance=10.0) if hasattr(term, "distance") else term
        for name, term in task.terminations.items()
    }
    return dataclasses.replace(task, terminations=ends)


@pytest.mark.full
def test_trials_are_told_by_clip(folder, monkeypatch):
    words = ["task=g1_track", "device=cpu", "num_envs=4"]
    run = conf.compose([*words, f"motions={folder}"])
    assert run.task.scene.motions[SET].sources == (str(folder),)
    cfg = dataclasses.replace(run, task=far(cfg_of(folder)))
    # Three clips at a time: the second round has one, and rows that are not counted.
    monkeypatch.setattr("ksim_rl.tracking.trials.MOST_ENVS", 9)
    found = run_trials(cfg, still(), trials=3, note=pytest.fail)
    assert [clip.clip for clip in found.clips] == list(FRAMES)
    assert [clip.held_out for clip in found.clips] == [True, False, False, False]
    assert (found.success, found.held_out, found.trials) == (1.0, 1.0, 3)
    # The first three envs draw what the three of the same clip's own task draw.
    alone = far(track_cfg(str(folder / "g1_kick.npz")))
    alone = dataclasses.replace(alone, sim=cfg.task.sim)
    one = run_trials(dataclasses.replace(run, task=alone), still(), trials=3, note=pytest.fail)
    assert found.clips[0].errors["r_mpkpe"] == pytest.approx(one.errors["body_pos_error"])
    assert found.clips[0].errors["mpkpe"] == pytest.approx(one.errors["body_drift"])
    steps = [count - 1 for name, count in FRAMES.items() if name != HELD_OUT]
    errors = [clip.errors["ee_pos_error"] for clip in found.clips if not clip.held_out]
    assert found.errors["ee_pos_error"] == pytest.approx(np.average(errors, weights=steps))
    lines = str(found).splitlines()
    assert lines[0].startswith("3 trials of each of 4 clips; trained on 3: 100.0% succeed")
    assert lines[1].startswith("  g1_kick (held out): 100.0%; mpkpe 0.")


def test_clips_are_held_out_by_name_and_by_share():
    names = ("bow", "kick_high", "kick_high_mirrored", "kick_low", "reach", "wave", "wave_mirrored")
    by_name = MotionSet(sources=("x",), held_out=("kick_high", "re.*"))
    assert by_name.held_out_of(names) == ("kick_high", "kick_high_mirrored", "reach")
    by_share = MotionSet(sources=("x",), held_out_share=0.4, seed=1)
    chosen = by_share.held_out_of(names)
    assert len({name.removesuffix("_mirrored") for name in chosen}) == 2
    assert chosen == by_share.held_out_of(names)
    drawn = {
        MotionSet(sources=("x",), held_out_share=0.4, seed=s).held_out_of(names) for s in range(9)
    }
    assert len(drawn) > 3
    for fields, message in (
        ({"held_out": ("kik.*",)}, "no clip matches 'kik"),
        ({"held_out": (".*",)}, "none of the 7 clips is left"),
        ({"held_out_share": 1.0}, "none of the 7 clips is left"),
        ({"held_out_share": 0.05}, "held_out_share=0.05: of 5 clips that is none"),
    ):
        with pytest.raises(ValueError, match=message):
            MotionSet(sources=("x",), **fields).held_out_of(names)


def test_what_is_no_set_is_refused(folder, tmp_path):
    for sources, message in (
        ((), "sources"),
        ((str(tmp_path),), "has no .npz file"),
        (("",), "one of them is empty"),
        ((str(folder), str(folder / "g1_walk.npz")), "same name 'g1_walk'"),
    ):
        with pytest.raises(ValueError, match=message):
            MotionSet(sources=sources).files()
