"""Motions in the form of tracking tasks: what is read, and that another order, unit or robot is found."""

import mujoco
import numpy as np
import pytest

from ksim_rl.clips.tracking_file import read_tracking
from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.scene.names import scalar_joint_ids
from tests.tracking.g1 import g1_model

FRAMES = 21


def arrays_of(model):
    """The walk's second second, as MuJoCo places the bodies, with a body that the robot does not have."""
    with np.load(motion_path("g1_walk")) as file:
        qpos_FL = file["qpos"][100 : 100 + FRAMES].astype(float)
    data = mujoco.MjData(model)
    pos = []
    quat = []
    for qpos in qpos_FL:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        pos.append([*data.xpos.copy(), (9.0, 9.0, 9.0)])
        quat.append([*data.xquat.copy(), (1.0, 0.0, 0.0, 0.0)])
    names = [model.joint(i).name for i in scalar_joint_ids(model)]
    return qpos_FL, {
        "fps": np.array([50]),
        "joint_pos": qpos_FL,
        "joint_vel": np.zeros((FRAMES, 35)),
        "body_pos_w": np.array(pos),
        "body_quat_w": np.array(quat),
        "joint_names": np.array(names),
        "body_names": np.array([*(model.body(i).name for i in range(model.nbody)), "spare"]),
    }


def test_the_joints_come_in_the_models_order_at_the_wanted_rate(tmp_path):
    model = g1_model()
    qpos_FL, arrays = arrays_of(model)
    np.savez(tmp_path / "a.npz", **arrays)
    assert read_tracking(tmp_path / "a.npz", model) == pytest.approx(qpos_FL, abs=1e-6)
    # Joints alone, in another order.
    order = np.random.default_rng(0).permutation(29)
    joints = qpos_FL[:, 7:][:, order]
    np.savez(
        tmp_path / "b.npz",
        **{**arrays, "joint_pos": joints, "joint_names": arrays["joint_names"][order]},
    )
    half = read_tracking(tmp_path / "b.npz", model, wanted_fps=25.0)
    assert half == pytest.approx(qpos_FL[::2], abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            lambda a: {"joint_pos": np.degrees(a["joint_pos"])},
            "from where body_pos_w has it.*radians",
        ),
        (lambda a: {"joint_names": a["joint_names"][::-1]}, "from where body_pos_w has it"),
        (
            lambda a: {"body_quat_w": np.roll(a["body_quat_w"], -1, -1)},
            "from where body_pos_w has it",
        ),
        (lambda a: {"body_quat_w": 2.0 * a["body_quat_w"]}, "'pelvis' has length 2"),
        (lambda a: {"joint_pos": a["joint_pos"][:, :35]}, "joint_pos has 35 columns"),
        (lambda a: {"joint_names": np.array(["knee", *a["joint_names"][1:]])}, "no joint 'knee'"),
        (lambda a: {"joint_names": a["joint_names"][1:]}, "lack 'left_hip_pitch_joint'"),
        (
            lambda a: {"body_names": np.array([f"b{i}" for i in range(a["body_names"].size)])},
            "'pelvis'",
        ),
        (lambda a: {"body_pos_w": a["body_pos_w"][:, 1:]}, "body_pos_w has shape"),
        (lambda a: {"fps": np.array([50, 50])}, "fps has shape"),
        (lambda a: {"body_pos_w": a["body_pos_w"] * np.nan}, "no finite number"),
        (lambda a: {"body_names": None}, "no array 'body_names'"),
        (lambda a: {"joint_names": np.array("x")}, r"joint_names has shape \(\)"),
        (
            # Degrees, and no body that tells.
            lambda a: {
                "joint_pos": np.rad2deg(a["joint_pos"]),
                "body_names": a["body_names"][1:2],
                "body_pos_w": a["body_pos_w"][:, 1:2],
                "body_quat_w": a["body_quat_w"][:, 1:2],
            },
            "the model has 'pelvis' alone",
        ),
    ],
)
def test_another_order_unit_or_robot_is_refused(tmp_path, changes, message):
    model = g1_model()
    _, arrays = arrays_of(model)
    changed = {**arrays, **changes(arrays)}
    np.savez(tmp_path / "a.npz", **{k: v for k, v in changed.items() if v is not None})
    with pytest.raises(ValueError, match=message):
        read_tracking(tmp_path / "a.npz", model)
