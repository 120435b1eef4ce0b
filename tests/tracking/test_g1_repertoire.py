"""The clips from which one policy learns: their kinds, and that the command writes what the robot can do."""

import mujoco
import numpy as np
import pytest

from ksim_rl.cli.main import main
from ksim_rl.scene.motions import MotionSet
from ksim_rl.tracking import motion_command
from ksim_rl.tracking.g1_motions import FIGURE, FPS
from ksim_rl.tracking.g1_repertoire import KINDS, REPERTOIRE, stepping, walk
from ksim_rl.tracking.keyframes import foot_paths
from tests.tracking.g1 import g1_model


def test_there_are_77_clips_of_thirteen_kinds():
    assert (len(KINDS), len(REPERTOIRE)) == (13, 77)
    assert all(len(variants) >= 4 for variants in KINDS.values())
    plans = [repr(clip.plan()) for clip in REPERTOIRE.values()]
    assert len(set(plans)) == len(plans), "no two are the same"
    for name, clip in REPERTOIRE.items():
        assert 2.0 < clip.plan().duration_s < 12.0, name


def test_steps_go_where_the_plan_says():
    plan = walk(0.2, turn=0.1, count=10)
    time_F = np.arange(round(plan.duration_s * FPS) + 1) / FPS
    paths_FN5, planted_FN = foot_paths(plan, time_F)
    heading = 0.0
    place_2 = np.zeros(2)
    for ahead in (0.1, *(0.2,) * 8):
        heading += 0.1
        place_2 += ahead * np.array((np.cos(heading), np.sin(heading)))
    moved_2 = paths_FN5[-1, :, :2].mean(0) - paths_FN5[0, :, :2].mean(0)
    assert moved_2 == pytest.approx(place_2, abs=1e-6)
    assert paths_FN5[-1, :, 3] == pytest.approx((0.9, 0.9))
    assert planted_FN.any(1).all()
    aside = stepping([(0.0, 0.1, 0.0), (0.0, 0.0, 0.0)])
    paths_FN5, _ = foot_paths(aside, np.arange(round(aside.duration_s * FPS)) / FPS)
    assert paths_FN5[-1, :, 1] - paths_FN5[0, :, 1] == pytest.approx((0.1, 0.1))


@pytest.mark.full
def test_the_command_writes_clips_and_their_mirror_images(tmp_path, capsys, monkeypatch):
    model = g1_model()
    with pytest.raises(SystemExit) as code:
        main(["motion", "generate", str(tmp_path / "clips"), "--only", "bow_nod|wave_easy"])
    assert code.value.code == 0 and "wave_easy: " in capsys.readouterr().out
    files = MotionSet(sources=(str(tmp_path / "clips"),)).files()
    assert list(files) == ["bow_nod", "bow_nod_mirrored", "wave_easy", "wave_easy_mirrored"]
    data = mujoco.MjData(model)
    highest = []
    for name in ("wave_easy", "wave_easy_mirrored"):
        data.qpos[:] = np.load(files[name])["qpos"][120]
        mujoco.mj_kinematics(model, data)
        highest.append(max(("left", "right"), key=lambda s: data.body(f"{s}_elbow_link").xpos[2]))
        assert data.site(FIGURE.feet[0]).xpos[2] == pytest.approx(FIGURE.sole_z, abs=2e-3)
    assert highest == ["left", "right"]
    monkeypatch.setattr("ksim_rl.tracking.feasibility.MOST_TORQUE", 0.0)
    with pytest.raises(SystemExit) as code:
        motion_command.motion(["generate", str(tmp_path / "none"), "--only", "bow_nod"]) and main(
            []
        )
    assert "bow_nod: not written: a motor gives" in capsys.readouterr().out
    assert list((tmp_path / "none").iterdir()) == []
