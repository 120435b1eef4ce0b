"""A trial succeeds if it reaches the end of the motion within the limits, and only then."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from ksim_rl import conf, mdp
from ksim_rl.cli import run_commands
from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.tracking.starts import StartOfTrial
from ksim_rl.tracking.tasks import HEIGHT_LIMIT, TASKS, UPRIGHT_LIMIT, track_cfg
from ksim_rl.tracking.trials import run_trials, trial_cfg
from ksim_rl.trainers.run_folder import Policy
from tests.conf.test_command_line import run
from tests.tracking.g1 import g1_model

STEPS = 12


@pytest.fixture(scope="module")
def short_clip(tmp_path_factory):
    """The first quarter of a second of the walk, in which the robot stands."""
    g1_model()
    path = tmp_path_factory.mktemp("clips") / "short.npz"
    with np.load(motion_path("g1_walk")) as file:
        arrays = {name: file[name] for name in file.files}
    cut = {name: arrays[name][: STEPS + 1] for name in ("qpos", "qvel")}
    np.savez(path, **{**arrays, **cut})
    return str(path)


def run_cfg(clip, **limits):
    cfg = conf.compose(["task=g1_track_walk", "device=cpu", "num_envs=4"])
    task = track_cfg(clip)
    terminations = {
        name: dataclasses.replace(term, distance=limits["distance"])
        if hasattr(term, "distance")
        else term
        for name, term in task.terminations.items()
    }
    # The engine that compiles nothing.
    sim = dataclasses.replace(task.sim, engine="c")
    task = dataclasses.replace(task, sim=sim, terminations=terminations)
    return dataclasses.replace(cfg, task=task)


def still():
    return TensorDictModule(
        lambda actor_EL: torch.zeros(*actor_EL.shape[:-1], 29), ["actor"], ["action"]
    )


def test_all_succeed_whom_no_limit_ends(short_clip):
    found = run_trials(run_cfg(short_clip, distance=10.0), still(), trials=6, note=pytest.fail)
    assert (found.trials, found.success) == (6, 1.0)
    assert 0.005 < found.errors["body_pos_error"] < 0.2
    assert "100.0% of 6 trials succeed" in str(found)


def test_the_command_says_how_many_succeed(short_clip, monkeypatch, capsys):
    policy = Policy(cfg=run_cfg(short_clip, distance=10.0), actor=still(), iteration=7)
    monkeypatch.setattr(run_commands.checkpoint, "load_latest", lambda path, note: None)
    monkeypatch.setattr(run_commands, "policy_of", lambda saved, device, cfg: policy)
    code, output = run(capsys, "eval", "some_run", "--trials", "6")
    assert code == 0 and "g1_track_walk, iteration 7: 100.0% of 6 trials succeed" in output.out
    for words, message in (
        (("--trials", "0"), "--trials=0: expected a whole number >= 1"),
        (("--trials", "6", "--episodes", "6"), "not allowed with argument --trials"),
        (("--pushes",), "give their number"),
    ):
        code, output = run(capsys, "eval", "some_run", *words)
        assert code == 2 and message in output.err


def test_none_succeeds_where_the_limit_is_tight(short_clip):
    # In a folder that is no set of the scene, there may be several clips.
    folder = Path(short_clip).parent
    shutil.copy(short_clip, folder / "once_more.npz")
    cfg = run_cfg(str(folder), distance=1e-4)
    found = run_trials(cfg, still(), trials=3, note=pytest.fail)
    assert found.success == 0.0 and [clip.clip for clip in found.clips] == ["once_more", "short"]


def test_trials_begin_with_the_motion_and_are_not_pushed():
    cfg = trial_cfg(track_cfg("g1_walk"))
    start = cfg.events["start"]
    assert isinstance(start, StartOfTrial)
    assert (start.clip, start.part_s, start.joint_range) == ("", None, 0.1)
    for fields in ({"start_range": (0.0, 0.5)}, {"part_s": 1.0}):
        with pytest.raises(ValueError, match="begins where it is set"):
            dataclasses.replace(start, **fields)
    assert "push_robot" not in cfg.events and {"foot_friction", "base_com", "default_pose"} <= set(
        cfg.events
    )
    assert cfg.curriculum == {}
    assert "push_robot" in trial_cfg(track_cfg("g1_walk"), pushes=True).events
    # Nor do they end by time, which is no success: a trial ends with its motion.
    whole = track_cfg("g1_walk")
    timed = {**whole.terminations, "time": mdp.TimeOut()}
    assert trial_cfg(dataclasses.replace(whole, terminations=timed)).terminations == dict(
        whole.terminations
    )


def test_a_task_without_a_motion_is_refused():
    cfg = conf.compose(["task=pendulum_swingup"]).task
    with pytest.raises(ValueError, match="StartInMotion.*g1_track_walk"):
        trial_cfg(cfg)


def test_trials_follow_one_motion():
    cfg = track_cfg("g1_walk")
    another = dataclasses.replace(cfg.events["start"], file="g1_kick")
    cfg = dataclasses.replace(cfg, events={**cfg.events, "another": another})
    with pytest.raises(ValueError, match="'start', 'another'.*g1_kick, g1_walk.*follow one"):
        trial_cfg(cfg)


def test_the_tasks_have_the_limits_of_the_peer():
    # mjlab, src/mjlab/tasks/tracking/tracking_env_cfg.py at 0eda4e7: anchor_pos, anchor_ori, ee_body_pos.
    assert (HEIGHT_LIMIT, UPRIGHT_LIMIT) == (0.25, 0.8)
    for task in TASKS:
        terminations = task.cfg().terminations
        assert (
            terminations["anchor_height"].distance == terminations["ends_height"].distance == 0.25
        )
        assert terminations["anchor_upright"].limit == 0.8
        assert not any(
            terminations[name].time_out
            for name in ("anchor_height", "anchor_upright", "ends_height")
        )
        assert terminations["finished"].time_out
