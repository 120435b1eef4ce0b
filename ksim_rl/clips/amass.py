"""Reads archives with joint rotations of the SMPL skeleton, as AMASS has them (Mahmood et al., 2019).

The body model itself is not here: a skeleton of mean proportions stands in for a person's own, unless offsets are
given. Limbs are as long as in Winter, "Biomechanics and Motor Control of Human Movement" (2009), figure 4.1, as shares
of height.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ksim_rl.clips.recording import Array, Recording, chain, from_rotation_vector, refused
from ksim_rl.files.arrays import read_arrays

HEIGHT = 1.70
"""m."""
# Name, parent, and offset from it as shares of height: x left, y up, z ahead, arms stretched out sideways.
_SKELETON: tuple[tuple[str, str, tuple[float, float, float]], ...] = (
    ("pelvis", "", (0.0, 0.0, 0.0)),
    ("left_hip", "pelvis", (0.05, -0.03, 0.0)),
    ("right_hip", "pelvis", (-0.05, -0.03, 0.0)),
    ("spine1", "pelvis", (0.0, 0.065, 0.0)),
    ("left_knee", "left_hip", (0.0, -0.245, 0.0)),
    ("right_knee", "right_hip", (0.0, -0.245, 0.0)),
    ("spine2", "spine1", (0.0, 0.08, 0.0)),
    ("left_ankle", "left_knee", (0.0, -0.246, 0.0)),
    ("right_ankle", "right_knee", (0.0, -0.246, 0.0)),
    ("spine3", "spine2", (0.0, 0.03, 0.0)),
    ("left_foot", "left_ankle", (0.0, -0.034, 0.07)),
    ("right_foot", "right_ankle", (0.0, -0.034, 0.07)),
    ("neck", "spine3", (0.0, 0.125, 0.0)),
    ("left_collar", "spine3", (0.045, 0.07, 0.0)),
    ("right_collar", "spine3", (-0.045, 0.07, 0.0)),
    ("head", "neck", (0.0, 0.052, 0.0)),
    ("left_shoulder", "left_collar", (0.06, 0.01, 0.0)),
    ("right_shoulder", "right_collar", (-0.06, 0.01, 0.0)),
    ("left_elbow", "left_shoulder", (0.159, 0.0, 0.0)),
    ("right_elbow", "right_shoulder", (-0.159, 0.0, 0.0)),
    ("left_wrist", "left_elbow", (0.146, 0.0, 0.0)),
    ("right_wrist", "right_elbow", (-0.146, 0.0, 0.0)),
)
JOINTS = tuple(name for name, _, _ in _SKELETON)
# The spelling differs between parts of the data set.
_RATES = ("mocap_framerate", "mocap_frame_rate")


def read_amass(
    path: Path, *, offsets: Mapping[str, Float[Array, " 3"]] | None = None, height: float = HEIGHT
) -> Recording:
    """Return where the 22 joints of the body are, in an archive with `poses`, `trans` and `mocap_framerate`.

    `poses` [F, 66 or more] are rotation vectors, rad, without the hands' rotations behind them; `trans` [F, 3] is m, z
    up, and the pelvis is there. `offsets` replaces some offsets of joints from their parents, m: x left, y up, z ahead.
    """
    poses_FC, root_F3, fps = _read(path)
    parents = []
    own_offsets = []
    for _, parent, offset in _SKELETON:
        # The pelvis hangs from nothing.
        parents.append(JOINTS.index(parent) if parent else -1)
        own_offsets.append(offset)
    # Offsets are in shares of height, given ones in m.
    offsets_N3 = height * np.array(own_offsets)
    for name, offset_3 in (offsets or {}).items():
        if name not in JOINTS:
            raise refused(path, f"offsets: no joint {name!r}", f"one of {', '.join(JOINTS)}")
        offsets_N3[JOINTS.index(name)] = offset_3
    # Three numbers per joint; columns beyond the body's joints are the hands.
    of_body_FC = poses_FC[:, : 3 * len(JOINTS)]
    turns_FN4 = from_rotation_vector(of_body_FC.reshape(len(poses_FC), -1, 3))
    pos_FN3, quat_FN4 = chain(parents, offsets_N3, turns_FN4, root_F3)
    return Recording(fps=fps, names=JOINTS, pos_FN3=pos_FN3, quat_FN4=quat_FN4)


def _read(path: Path) -> tuple[Array, Array, float]:
    try:
        arrays = read_arrays(path)
    except ValueError as error:
        raise refused(
            path, f"cannot be read as .npz: {error}", "give an archive of AMASS"
        ) from None
    rate = next((name for name in _RATES if name in arrays), "")
    missing = [name for name in ("poses", "trans") if name not in arrays]
    if missing or not rate:
        # The first missing array, or the rate under its usual name.
        lacks = (missing or [_RATES[0]])[0]
        raise refused(path, f"no array {lacks!r}", f"it has {', '.join(arrays) or 'none'}")
    poses_FC = arrays["poses"]
    root_F3 = arrays["trans"]
    # Objects are refused before any arithmetic.
    if arrays[rate].size != 1 or any(
        array.dtype.kind not in "fiu" for array in (poses_FC, root_F3, arrays[rate])
    ):
        raise refused(
            path, f"poses, trans or {rate} are no numbers, or {rate} is not one", "repair it"
        )
    fps = float(arrays[rate].item())
    if poses_FC.ndim != 2 or poses_FC.shape[1] < 3 * len(JOINTS) or len(poses_FC) < 2:
        raise refused(
            path,
            f"poses has shape {poses_FC.shape}",
            f"expected [F, {3 * len(JOINTS)} or more], F >= 2",
        )
    # A place for each frame.
    if root_F3.shape != (len(poses_FC), 3):
        raise refused(path, f"trans has shape {root_F3.shape}", f"expected ({len(poses_FC)}, 3)")
    if not (np.isfinite(poses_FC).all() and np.isfinite(root_F3).all() and fps > 0.0):
        raise refused(
            path,
            "it holds numbers that are not finite, or a rate that is not positive",
            "repair it",
        )
    # In float64: the chain of 22 joints adds up rounding errors.
    return poses_FC.astype(float), root_F3.astype(float), fps
