"""Reading of reference motions, and states between their frames."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.scene.motions.motion import load_motion
from tests.mdp.bench import FREE_BODY

CPU = torch.device("cpu")
HALF = np.sqrt(0.5)


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(FREE_BODY)


def frames(**changes):
    """Three frames at 10 Hz: the trunk moves 1 m a frame along x and turns by 0, 90 and 180 degrees about z."""
    qpos = np.zeros((3, 9))
    qpos[:, 0], qpos[:, 7] = np.arange(3), 0.1 * np.arange(3)
    qpos[:, 3:7] = [(1, 0, 0, 0), (HALF, 0, 0, HALF), (0, 0, 0, 1)]
    qvel = np.zeros((3, 8))
    qvel[:, 0] = (10.0, 20.0, 40.0)
    return {"fps": np.array(10.0), "qpos": qpos, "qvel": qvel} | changes


def saved(tmp_path, **changes):
    file = tmp_path / "clip.npz"
    np.savez(file, **{key: value for key, value in frames(**changes).items() if value is not None})
    return file


def test_frames_are_met_and_the_ends_hold(model, tmp_path):
    motion = load_motion(saved(tmp_path), model, CPU)
    assert (motion.duration_s, motion.fps) == (0.2, 10.0)
    qpos_EL, qvel_EL = motion.sample(torch.tensor([0.0, 0.1, 0.2, 0.3, -1.0]))
    expected = torch.tensor(frames()["qpos"], dtype=torch.float32)[[0, 1, 2, 2, 0]]
    torch.testing.assert_close(qpos_EL, expected, atol=1e-6, rtol=0)
    assert qvel_EL[:, 0].tolist() == pytest.approx([10, 20, 40, 40, 10])


def test_between_frames_positions_are_linear_and_turns_take_the_shorter_way(model, tmp_path):
    qpos = frames()["qpos"]
    qpos[1, 3:7] *= -1.0  # the same orientation
    motion = load_motion(saved(tmp_path, qpos=qpos), model, CPU)
    qpos_EL, qvel_EL = motion.sample(torch.tensor([0.05, 0.15]))
    assert qpos_EL[:, 0].tolist() == pytest.approx([0.5, 1.5]) and qpos_EL[
        :, 7
    ].tolist() == pytest.approx([0.05, 0.15])
    assert qvel_EL[:, 0].tolist() == pytest.approx([15.0, 30.0])
    for row, angle in zip(qpos_EL, (np.pi / 4, 3 * np.pi / 4), strict=True):
        expected = np.zeros(4)
        mujoco.mju_axisAngle2Quat(expected, np.array([0.0, 0.0, 1.0]), angle)
        assert abs(float(np.dot(row[3:7].numpy(), expected))) == pytest.approx(1.0, abs=1e-6)


def test_joint_names_that_are_the_models_are_accepted(model, tmp_path):
    load_motion(
        saved(tmp_path, joint_names=np.array(["root", "left_hip", "right_hip"])), model, CPU
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"qpos": np.zeros((3, 8))}, r"qpos has shape \(3, 8\): expected \[F, 9\]"),
        ({"qvel": np.zeros((2, 8))}, "qpos has 3 frames and qvel 2"),
        ({"qvel": np.full((3, 8), np.nan)}, "qvel holds a number that is not finite"),
        ({"qvel": np.full((3, 8), 1e300)}, "qvel holds a number that is not finite in float32"),
        ({"qvel": np.zeros((3, 8), np.longdouble)}, "qvel is .*: expected numbers of at most 64"),
        ({"joint_names": np.array("root")}, r"joint_names has shape \(\): expected one name"),
        ({"fps": np.array(0.0)}, "fps=0.0"),
        ({"qpos": np.zeros((3, 9))}, "quaternions of lengths 0 to 0"),
        ({"qpos": None}, "no array 'qpos': it has fps, qvel"),
        ({"qpoz": np.zeros(3)}, "unknown array 'qpoz': did you mean 'qpos'"),
        (
            {"joint_names": np.array(["root", "left_hipp", "right_hip"])},
            "no joint 'left_hipp': did you mean 'left_hip'",
        ),
        (
            {"joint_names": np.array(["root", "right_hip", "left_hip"])},
            "expected the model's joints in their order",
        ),
        ({"fps": np.array([object()])}, "cannot be read as .npz without pickles"),
    ],
)
def test_what_does_not_fit_the_model_is_refused(model, tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        load_motion(saved(tmp_path, **changes), model, CPU)


def test_a_file_that_is_no_archive_is_refused(model, tmp_path):
    file = tmp_path / "clip.npz"
    with pytest.raises(ValueError, match="no such file, .* with the package: .*walker_walk"):
        load_motion(file, model, CPU)
    file.write_bytes(b"PK\x03\x04nothing")
    with pytest.raises(ValueError, match="cannot be read as .npz"):
        load_motion(file, model, CPU)
    np.save(tmp_path / "clip.npy", np.zeros(3))
    with pytest.raises(ValueError, match="no archive of arrays"):
        load_motion(tmp_path / "clip.npy", model, CPU)
