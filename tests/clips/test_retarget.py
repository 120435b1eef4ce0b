"""Retargeting: a robot that follows itself does the same, one that follows a person keeps its feet on the ground."""

import mujoco
import numpy as np
import pytest
import yaml

from ksim_rl.cli.main import main
from ksim_rl.clips.recording import of_robot
from ksim_rl.clips.retarget import Pair, Retarget, read_retarget, retargeted
from ksim_rl.scene.motions.motion import motion_path
from tests.tracking.g1 import g1_model

ENDS = (
    "left_ankle_roll_link",
    "right_ankle_roll_link",
    "left_wrist_yaw_link",
    "right_wrist_yaw_link",
)
BODIES = (
    "pelvis",
    "torso_link",
    "left_knee_link",
    "right_knee_link",
    "left_elbow_link",
    "right_elbow_link",
    *ENDS,
)


@pytest.fixture(scope="module")
def walk():
    model = g1_model()
    qpos_FL = np.load(motion_path("g1_walk"))["qpos"][60:130].astype(float)
    return model, qpos_FL, of_robot(model, qpos_FL, 50.0)


def test_a_robot_that_follows_its_own_bodies_does_what_it_did(walk):
    model, qpos_FL, recording = walk
    pairs = tuple(Pair(point=body, to=body, turn_weight=0.3) for body in BODIES)
    cfg = Retarget(pairs=pairs, posture_weight=1e-3, stride_weight=1e-3)
    found = of_robot(model, retargeted(recording, model, cfg), 50.0)
    places = [recording.names.index(body) for body in BODIES]
    away = np.linalg.norm(found.pos_FN3[:, places] - recording.pos_FN3[:, places], axis=-1)
    assert away.max() < 2e-3


def test_it_is_continuous_and_keeps_the_ranges_where_points_jump_out_of_reach(walk):
    model, _, recording = walk
    cfg = Retarget(pairs=tuple(Pair(point=body, to=body) for body in ("pelvis", *ENDS)), scale=1.2)
    qpos_FL = retargeted(recording, model, cfg)
    low, high = model.jnt_range[1:].T
    assert (qpos_FL[:, 7:] >= low).all() and (qpos_FL[:, 7:] <= high).all()
    assert np.abs(np.diff(qpos_FL[:, 7:], axis=0)).max() < 0.35, "rad from frame to frame"


def test_soles_touch_the_ground_in_their_lowest_frames(walk):
    model, _, recording = walk
    pairs = tuple(Pair(point=body, to=body) for body in ("pelvis", *ENDS))
    cfg = Retarget(pairs=pairs, scale=0.9, soles=("left_foot", "right_foot"), sole_z=0.01)
    data, heights = mujoco.MjData(model), []
    for qpos in retargeted(recording, model, cfg):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        heights.append(min(data.site(site).xpos[2] for site in cfg.soles))
    assert np.percentile(heights, 5.0) == pytest.approx(0.01, abs=1e-9)


def test_names_that_do_not_exist_give_the_near_ones(walk):
    model, _, recording = walk
    with pytest.raises(ValueError, match="no point 'pelvs'.*'pelvis'"):
        retargeted(recording, model, Retarget(pairs=(Pair(point="pelvs", to="pelvis"),)))
    with pytest.raises(ValueError, match="no site or body 'nose'"):
        retargeted(recording, model, Retarget(pairs=(Pair(point="pelvis", to="nose"),)))
    with pytest.raises(ValueError, match="at least one pair"):
        Retarget(pairs=())


def test_the_command_turns_a_persons_archive_into_a_motion_file(tmp_path, capsys):
    model = g1_model()
    poses = np.zeros((7, 66))
    poses[:, :3] = (np.pi / 2, 0.0, 0.0)
    trans = np.tile((0.0, 0.0, 0.9), (7, 1))
    np.savez(tmp_path / "person.npz", poses=poses, trans=trans, mocap_framerate=np.array(30.0))
    table = {
        "scale": 0.75,
        "soles": ["left_foot", "right_foot"],
        "pairs": [
            {"point": "pelvis", "to": "pelvis"},
            {"point": "left_ankle", "to": "left_ankle_roll_link"},
            {"point": "right_ankle", "to": "right_ankle_roll_link"},
        ],
    }
    (tmp_path / "pairs.yaml").write_text(yaml.safe_dump(table))
    assert read_retarget(tmp_path / "pairs.yaml").pairs[1] == Pair(
        point="left_ankle", to="left_ankle_roll_link"
    )
    source, made = str(tmp_path / "person.npz"), str(tmp_path / "made.npz")

    def code(*words: str) -> int:
        with pytest.raises(SystemExit) as ended:
            main(["motion", *words])
        return ended.value.code  # pyright: ignore[reportReturnType]

    assert code("amass", source, made, "--pairs", str(tmp_path / "pairs.yaml")) == 0
    assert "11 frames, 0.20 s" in capsys.readouterr().out
    assert np.load(made)["qpos"].shape == (11, model.nq)
    assert code("csv", source, made) == 2
    assert "it is no text" in capsys.readouterr().err
    (tmp_path / "pairs.yaml").write_text("[1, 2]")
    assert code("amass", source, made, "--pairs", str(tmp_path / "pairs.yaml")) == 2
    assert "expected a mapping with `pairs`" in capsys.readouterr().err
    assert code("csv", source, made, "--robot", "g2") == 2
    assert "valid: g1, humanoid, t1" in capsys.readouterr().err
