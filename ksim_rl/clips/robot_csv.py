"""Reads motions of a robot from CSV files: root position, root quaternion and joint positions in each line.

It is the layout that mjlab's `csv_to_npz` and Unitree's retargeted LAFAN1 files have: x, y, z (m), qx, qy, qz, qw, then
the joints in the model's order (rad), without a header.
"""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.checks import near
from ksim_rl.clips.recording import refused, resampled_qpos
from ksim_rl.files.reading import MOST_TEXT_BYTES, read_bytes
from ksim_rl.scene.names import scalar_joint_ids

Array = np.ndarray


def read_csv(
    path: Path,
    mj_model: mujoco.MjModel,
    *,
    fps: float,
    wanted_fps: float = 50.0,
    joints: Sequence[str] | None = None,
) -> Float[Array, "F L"]:
    """Return the qpos of a model with a free root from a CSV file, resampled from `fps` to `wanted_fps`.

    `joints` names the file's columns behind the seventh, if they are not the model's hinges and slides in its order;
    joints that it leaves out stay as in the model's first keyframe. A ValueError names the fault and its line.
    """
    own = [mj_model.joint(i).name for i in scalar_joint_ids(mj_model)]
    # Files of retargeted motions often have the joints of another version of the robot.
    joints = own if joints is None else list(joints)
    for joint in joints:
        if joint not in own:
            raise ValueError(
                f"motion {path}: joints: the model has no joint {joint!r}: {near(joint, own)}"
            )
    if not mj_model.njnt or mj_model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise refused(
            path, "the model's first joint is not free", "give the model of a robot that can move"
        )
    table_FC = _table(path, 7 + len(joints))
    # Rounded files have quaternions that are nearly unit; anything else is another column order.
    norm_F = np.linalg.norm(table_FC[:, 3:7], axis=1)
    if (np.abs(norm_F - 1.0) > 0.05).any():
        line = int(np.abs(norm_F - 1.0).argmax()) + 1
        raise refused(
            path,
            f"line {line}, columns 4 to 7: a quaternion of length {norm_F[line - 1]:.3g}",
            "expected unit quaternions (x, y, z, w) behind the root's position",
        )
    if mj_model.nkey:
        rest_L = mj_model.key_qpos[0]
    else:
        rest_L = mj_model.qpos0
    # Joints that the file leaves out stay as in this pose.
    qpos_FL = np.tile(rest_L, (len(table_FC), 1))
    qpos_FL[:, :3] = table_FC[:, :3]
    quat_F4 = table_FC[:, 3:7] / norm_F[:, None]
    # From (x, y, z, w) to MuJoCo's (w, x, y, z).
    qpos_FL[:, 3:7] = quat_F4[:, [3, 0, 1, 2]]
    places = [int(mj_model.joint(joint).qposadr[0]) for joint in joints]
    qpos_FL[:, places] = table_FC[:, 7:]
    return resampled_qpos(qpos_FL, fps, wanted_fps)


def _table(path: Path, columns: int) -> Array:
    try:
        text = read_bytes(path, limit=MOST_TEXT_BYTES, follows_links=True).decode()
    except UnicodeDecodeError:
        raise refused(path, "it is no text", "give a CSV file") from None
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        # Empty lines are common at the end of a file.
        if not line.strip():
            continue
        cells = line.split(",")
        if len(cells) != columns:
            raise refused(
                path,
                f"line {number} has {len(cells)} columns",
                f"expected {columns}: 3 of position, 4 of a quaternion (x, y, z, w), {columns - 7} joints; name those "
                "of the file, if they are others",
            )
        try:
            # No header: a row of names fails here, and the error has its line.
            row = [float(cell) for cell in cells]
        except ValueError as error:
            raise refused(
                path, f"line {number}: {error}", "expected numbers only, and no header"
            ) from None
        if not np.isfinite(row).all():
            raise refused(
                path, f"line {number} holds a number that is not finite", "cut that part off"
            )
        rows.append(row)
    # Two frames at least, since velocities are differences.
    if len(rows) < 2:
        raise refused(path, f"it has {len(rows)} lines", "expected at least two frames")
    return np.array(rows)
