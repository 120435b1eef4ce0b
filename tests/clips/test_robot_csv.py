"""CSV files of robots: round trips, other rates, velocities, and what is wrong in a line."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.clips.motion_file import velocities, write_motion
from ksim_rl.clips.robot_csv import read_csv
from ksim_rl.scene.motions.motion import load_motion
from tests.mdp.bench import FREE_BODY

SECONDS, FPS = 2.0, 30.0


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(FREE_BODY)


def exact(model, time_F):
    """A trunk that moves at 1 m/s along x and turns at 1.5 rad/s about a slanting axis; joints by cosines."""
    qpos_FL = np.zeros((len(time_F), model.nq))
    qpos_FL[:, 0], qpos_FL[:, 2] = time_F, 0.5
    axis_3 = np.array((0.0, 0.6, 0.8))
    for frame, time in enumerate(time_F):
        mujoco.mju_axisAngle2Quat(qpos_FL[frame, 3:7], axis_3, 1.5 * time)
    for joint in range(7, model.nq):
        qpos_FL[:, joint] = 0.3 * np.cos(time_F + joint)
    return qpos_FL, 1.5 * axis_3


def written(path, qpos_FL):
    columns = [0, 1, 2, 4, 5, 6, 3, *range(7, qpos_FL.shape[1])]
    np.savetxt(path, qpos_FL[:, columns], delimiter=",", fmt="%.9f")
    return path


def test_a_file_comes_back_at_the_control_rate_with_its_velocities(model, tmp_path):
    source_FL, turning_3 = exact(model, np.arange(int(SECONDS * FPS) + 1) / FPS)
    path = written(tmp_path / "a.csv", source_FL)
    time_F = np.arange(101) / 50.0
    expected_FL, _ = exact(model, time_F)
    found_FL = read_csv(path, model, fps=FPS)
    assert found_FL.shape == expected_FL.shape
    assert found_FL[:, :7] == pytest.approx(expected_FL[:, :7], abs=1e-6)
    # Between frames of a cosine a straight line is off by a^2 dt^2 / 8.
    assert found_FL[:, 7:] == pytest.approx(expected_FL[:, 7:], abs=0.3 / FPS**2 / 8 + 1e-6)

    qvel_FM = velocities(model, expected_FL, 50.0)
    assert qvel_FM[:, :3] == pytest.approx(np.tile((1.0, 0.0, 0.0), (101, 1)), abs=1e-6)
    # Turning about a fixed axis, which is the same in the world and in the body.
    assert qvel_FM[:, 3:6] == pytest.approx(np.tile(turning_3, (101, 1)), abs=1e-6)
    assert qvel_FM[1:-1, 6:] == pytest.approx(
        -0.3 * np.sin(time_F[1:-1, None] + np.arange(7, model.nq)), abs=1e-4
    )

    write_motion(tmp_path / "a.npz", model, found_FL, 50.0)
    motion = load_motion(tmp_path / "a.npz", model, torch.device("cpu"))
    assert motion.duration_s == pytest.approx(SECONDS) and motion.fps == 50.0
    assert motion.qpos_FL.numpy() == pytest.approx(found_FL, abs=1e-6)
    with pytest.raises(ValueError, match="a motion of 1 frames at 50 per second: expected two"):
        write_motion(tmp_path / "b.npz", model, found_FL[:1], 50.0)
    assert not (tmp_path / "b.npz").exists()


def test_angular_velocity_is_in_the_body_frame_as_the_engine_integrates_it(model):
    draw = np.random.default_rng(1)
    qpos_L, frames = np.zeros(model.nq), []
    qpos_L[3] = 1.0
    qvel_M = draw.normal(size=model.nv)
    for _ in range(5):
        frames.append(qpos_L.copy())
        mujoco.mj_integratePos(model, qpos_L, qvel_M, 0.02)
    assert velocities(model, np.array(frames), 50.0) == pytest.approx(
        np.tile(qvel_M, (5, 1)), abs=1e-6
    )


def test_columns_may_be_named_and_others_rest(model, tmp_path):
    names = [model.joint(i).name for i in range(1, model.njnt)]
    table = np.tile((0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.25), (3, 1))
    np.savetxt(tmp_path / "a.csv", table, delimiter=",")
    found_FL = read_csv(tmp_path / "a.csv", model, fps=50.0, joints=[names[-1]])
    assert (found_FL[:, model.joint(names[-1]).qposadr[0]] == 0.25).all()
    with pytest.raises(ValueError, match=r"a\.csv: joints: the model has no joint 'nose'"):
        read_csv(tmp_path / "a.csv", model, fps=50.0, joints=["nose"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda line: line + ",1", r"line 2 has \d+ columns: expected \d+: 3 of position"),
        (lambda line: "up" + line[line.index(",") :], "line 2: could not convert.*no header"),
        (lambda line: "nan" + line[line.index(",") :], "line 2 holds a number that is not finite"),
        (
            lambda line: "9," * line.count(",") + "9",
            "line 2, columns 4 to 7: a quaternion of length 18",
        ),
    ],
)
def test_what_is_wrong_in_a_line_is_named(model, tmp_path, change, message):
    path = written(tmp_path / "a.csv", exact(model, np.arange(3) / FPS)[0])
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], change(lines[1]), lines[2]]))
    with pytest.raises(ValueError, match=rf"motion .*a\.csv: {message}"):
        read_csv(path, model, fps=FPS)


def test_one_frame_is_no_motion(model, tmp_path):
    path = written(tmp_path / "a.csv", exact(model, np.zeros(1))[0])
    with pytest.raises(ValueError, match="it has 1 lines: expected at least two frames"):
        read_csv(path, model, fps=FPS)
