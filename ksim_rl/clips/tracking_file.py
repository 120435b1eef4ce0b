"""Reads motions of a robot in the form that mjlab's and BeyondMimic's tracking tasks have, with where bodies were.

An `.npz` file has `fps`, `joint_pos` [F, N] or, with the root's position and quaternion (w, x, y, z) in front,
[F, 7 + N], `body_pos_w` [F, B, 3], `body_quat_w` [F, B, 4] (w, x, y, z), `joint_names` and `body_names`. Names and
bodies are compared with the robot's own, so that another order, degrees, or another robot are found.
"""

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.checks import near
from ksim_rl.clips.recording import refused, resampled_qpos
from ksim_rl.files.arrays import read_arrays
from ksim_rl.scene.motions.frames import in_each_frame
from ksim_rl.scene.names import scalar_joint_ids

Array = np.ndarray
SHAPES = {"fps": 0, "joint_pos": 2, "body_pos_w": 3, "body_quat_w": 3}
NAMES = ("joint_names", "body_names")
MOST_OFF = 0.05
"""m: how far bodies may be from where the joints put them, as robots of one name differ a little."""


def read_tracking(
    path: Path, mj_model: mujoco.MjModel, *, wanted_fps: float = 50.0
) -> Float[Array, "F L"]:
    """Return the qpos of a model with a free root from such a file, resampled to `wanted_fps`.

    Bodies that only one of the two has are left out of the comparison. A ValueError names the fault.
    """
    arrays = _checked_arrays(path)
    own = [mj_model.joint(i).name for i in scalar_joint_ids(mj_model)]
    joints = [str(name) for name in arrays["joint_names"]]
    for joint in joints:
        if joint not in own:
            raise refused(path, f"the model has no joint {joint!r}", near(joint, own))
    missing = [joint for joint in own if joint not in joints]
    if missing:
        raise refused(
            path,
            f"joint_names lack {missing[0]!r}",
            "give the model of the robot that has these joints",
        )
    joint_pos_FL = arrays["joint_pos"].astype(float)
    bodies = [str(name) for name in arrays["body_names"]]
    width = joint_pos_FL.shape[1]
    if width not in (len(joints), 7 + len(joints)):
        raise refused(
            path,
            f"joint_pos has {width} columns",
            f"expected {len(joints)}, one for each of joint_names, or 7 more in front: the root's position and "
            "quaternion (w, x, y, z)",
        )
    root = mj_model.body(int(mj_model.jnt_bodyid[0])).name
    if root not in bodies:
        raise refused(path, f"body_names lack the root {root!r}", near(root, bodies))
    qpos_FL = np.zeros((len(joint_pos_FL), mj_model.nq))
    place = bodies.index(root)
    # The root's pose is among the bodies', also where the joints have it in front.
    qpos_FL[:, :3] = arrays["body_pos_w"][:, place]
    qpos_FL[:, 3:7] = arrays["body_quat_w"][:, place]
    columns = [int(mj_model.joint(joint).qposadr[0]) for joint in joints]
    qpos_FL[:, columns] = joint_pos_FL[:, width - len(joints) :]
    norm_F = np.linalg.norm(qpos_FL[:, 3:7], axis=1)
    if (np.abs(norm_F - 1.0) > 0.01).any():
        raise refused(
            path,
            f"body_quat_w of {root!r} has length {norm_F[np.abs(norm_F - 1.0).argmax()]:.3g}",
            "expected unit quaternions (w, x, y, z)",
        )
    qpos_FL[:, 3:7] /= norm_F[:, None]
    _check_bodies(path, mj_model, qpos_FL, arrays["body_pos_w"], bodies)
    return resampled_qpos(qpos_FL, float(arrays["fps"].item()), wanted_fps)


def _checked_arrays(path: Path) -> Mapping[str, Array]:
    try:
        arrays = read_arrays(path)
    except ValueError as error:
        raise refused(path, str(error), "give an .npz file without pickles") from None
    for name in (*SHAPES, *NAMES):
        if name not in arrays:
            raise refused(
                path,
                f"no array {name!r}",
                "expected the form of tracking tasks; name joints and bodies by joint_names and body_names",
            )
    for name, dims in SHAPES.items():
        array = arrays[name]
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise refused(path, f"{name} holds something that is no finite number", "repair it")
        if name == "fps":
            is_right = array.size == 1
        else:
            is_right = array.ndim == dims and len(array) == len(arrays["joint_pos"]) > 1
        if not is_right:
            raise refused(
                path,
                f"{name} has shape {array.shape}",
                "expected one rate, and two frames or more, as many in each array",
            )
    for name in NAMES:
        if arrays[name].ndim != 1:
            raise refused(
                path, f"{name} has shape {arrays[name].shape}", "expected a list of names"
            )
    bodies = len(arrays["body_names"])
    for name, width in (("body_pos_w", 3), ("body_quat_w", 4)):
        if arrays[name].shape[1:] != (bodies, width):
            raise refused(
                path, f"{name} has shape {arrays[name].shape}", f"expected [F, {bodies}, {width}]"
            )
    return arrays


def _check_bodies(
    path: Path, mj_model: mujoco.MjModel, qpos_FL: Array, body_pos_FN3: Array, bodies: list[str]
) -> None:
    """Refuse joints that put bodies elsewhere than the file has them: wrong units, order or robot."""
    own = {mj_model.body(i).name: i for i in range(1, mj_model.nbody)}
    shared = [name for name in bodies if name in own]
    # The root is where the file has it, whatever the joints are.
    root = mj_model.body(int(mj_model.jnt_bodyid[0])).name
    if set(shared) <= {root}:
        raise refused(
            path,
            f"of its body_names the model has {root!r} alone",
            "name bodies that the joints move, feet and hands among them",
        )
    frames = range(0, len(qpos_FL), max(1, len(qpos_FL) // 20))
    for frame, data in zip(frames, in_each_frame(mj_model, qpos_FL[frames]), strict=True):
        for name in shared:
            away = np.linalg.norm(data.xpos[own[name]] - body_pos_FN3[frame, bodies.index(name)])
            if away > MOST_OFF:
                raise refused(
                    path,
                    f"frame {frame}: its joints put {name!r} {away:.2f} m from where body_pos_w has it",
                    "expected radians in the order of joint_names, quaternions (w, x, y, z), and this robot",
                )
