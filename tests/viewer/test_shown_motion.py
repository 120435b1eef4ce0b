"""The viewer's choice of a clip and a time: what robots follow, or are put into, is there in the motion's own file."""

import dataclasses
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.scene.motions import MotionSet, motion_path
from ksim_rl.scene.state.motion_clock import motion_clip
from ksim_rl.tracking.tasks import SET, track_cfg, track_set_cfg
from ksim_rl.viewer import Conditions, Session
from ksim_rl.viewer.session import UntrainedAgent, showing_motion
from ksim_rl.viewer.shown_motion import following, place_of, with_choice

CLIPS = ("g1_walk", "g1_squat", "g1_turn", "g1_kick")


def session_of(cfg) -> Session:
    cfg = dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, num_envs=2),
        # The engine that compiles nothing.
        sim=dataclasses.replace(cfg.sim, engine="c"),
    )
    return Session(
        lambda conditions: envs.build(with_choice(conditions.apply(cfg))),
        lambda env: UntrainedAgent("zero", env),
    )


def frame(clip: str, number: int) -> torch.Tensor:
    with np.load(motion_path(clip)) as file:
        return torch.tensor(file["qpos"][number], dtype=torch.float32)


@pytest.fixture(scope="module")
def shown(tmp_path_factory) -> Session:
    """The planar walker plays its walk, or the middle of it."""
    with np.load(motion_path("walker_walk")) as file:
        arrays = {name: file[name] for name in file.files}
    cut = {name: arrays[name][100:150] for name in ("qpos", "qvel")}
    path = tmp_path_factory.mktemp("clips") / "middle.npz"
    np.savez(path, **{**arrays, **cut})
    cfg = envs.make_cfg("walker_track")
    motions = {SET: MotionSet(sources=("walker_walk", str(path)), held_out=("middle",))}
    cfg = dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, motions=motions))
    return session_of(showing_motion(cfg, SET, clip="middle"))


def test_a_set_is_shown_from_any_moment_of_any_clip(shown):
    motion = shown.motion
    assert motion.clip(1) == 1 and motion.time_s(1) == 0.0
    for clip, moved in ((0, 0), (1, 100)):
        shown.seek(clip, 0.6)
        for number in (30, 31, 32):
            assert motion.clip(0) == clip
            assert motion.time_s(0) == pytest.approx(number / 50.0, abs=1e-5)
            torch.testing.assert_close(
                shown.ours.world.qpos_EL[0],
                frame("walker_walk", moved + number),
                atol=1e-4,
                rtol=0,
            )
            shown.step_once()
    # From its end, 49 frames after its start, it begins again.
    shown.seek(1, 0.96)
    shown.step_once()
    shown.step_once()
    assert motion.time_s(0) == pytest.approx(0.02, abs=1e-4)


@pytest.mark.full
def test_a_policy_follows_the_clip_from_the_moment():
    session = session_of(following(track_set_cfg(), "g1_turn"))
    motion = session.motion
    assert motion.clip(0) == 2 and motion.time_s(0) == 0.0
    session.seek(1, 3.0)
    # Off the motion by the errors of starts: 0.1 rad, and the root by some centimetres.
    away_EL = (session.ours.world.qpos_EL - frame("g1_squat", 150)).abs()
    assert away_EL[:, :3].max() < 0.06 and away_EL[:, 7:].max() < 0.11 and away_EL.max() > 0.01
    session.step_once()
    assert motion_clip(session.ours.view, SET).tolist() == [1, 1]
    assert motion.time_s(0) == pytest.approx(3.02, abs=1e-5)
    # An env that is built again is at the same place.
    session.change(Conditions(randomization=False))
    assert session.motion.clip(0) == 1 and session.motion.time_s(0) == pytest.approx(3.0)
    session.seek(1, 1e6)
    assert session.motion.time_s(0) == pytest.approx(float(session.motion.motion.duration_C[1]))
    for clip, time_s, message in (
        (4, 0.0, "clip 4: expected 0 to 3"),
        (0, -1.0, "time_s=-1.0"),
        (0, float("nan"), "time_s=nan"),
    ):
        with pytest.raises(ValueError, match=message):
            session.seek(clip, time_s)


def test_the_panel_seeks_and_follows(shown):
    from ksim_rl.viewer.panel import Panel

    gui = MagicMock()
    made = {}

    def add(label, *values):
        made[label] = SimpleNamespace(on_update=MagicMock(), step=values[-2:][0], options=values[0])
        return made[label]

    gui.add_dropdown.side_effect = add
    gui.add_slider.side_effect = add
    panel = Panel(gui, shown)
    clip, time = made["Clip"], made["Time (s)"]
    assert clip.options == ["walker_walk", "middle (held out)"]
    shown.seek(0, 1.0)
    panel.show()
    assert clip.value == "walker_walk" and time.value == pytest.approx(1.0)
    # What the program has set asks for nothing.
    asked, by_hand = (SimpleNamespace(client=client) for client in (None, 1))
    (moved,) = clip.on_update.call_args.args
    (scrubbed,) = time.on_update.call_args.args
    shown.play(False)
    clip.value = "middle (held out)"
    moved(asked)
    shown.advance()
    assert shown.motion.clip(0) == 0
    moved(by_hand)
    shown.advance()
    assert shown.motion.clip(0) == 1 and shown.motion.time_s(0) == 0.0
    time.value = 0.5
    scrubbed(by_hand)
    shown.advance()
    assert shown.motion.time_s(0) == pytest.approx(0.5)


def test_names_of_clips_are_found_and_others_refused():
    cfg = track_set_cfg()
    assert place_of(cfg, "g1_kick") == (SET, "g1_kick")
    assert place_of(cfg, SET) == (SET, "")
    assert place_of(cfg, "walker_walk") == ("walker_walk", "")
    with pytest.raises(ValueError, match="--motion g1_kik: the task follows clips, .* 'g1_kick'"):
        following(cfg, "g1_kik")
    start = following(track_cfg("g1_walk"), "g1_walk").events["start"]
    assert start.clip == "g1_walk" and with_choice(cfg).events["start"].clip == ""
    # What follows no motion, or two, stays as it is.
    plain = envs.make_cfg("cartpole_balance")
    assert with_choice(plain) is plain
    events = {**cfg.events, "other": dataclasses.replace(cfg.events["start"], file="g1_walk")}
    both = dataclasses.replace(cfg, events=events)
    assert with_choice(both) is both
    held_out = MotionSet(sources=CLIPS, held_out=("g1_kick",))
    scene = dataclasses.replace(cfg.scene, motions={SET: held_out})
    assert following(dataclasses.replace(cfg, scene=scene), "g1_kick").curriculum == {}
