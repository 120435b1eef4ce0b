"""A recording is where named points of a body were over time; it is resampled here, and read off a robot's motion."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.checked import Checked, Positive
from ksim_rl.checks import check_in_range
from ksim_rl.scene.motions.frames import in_each_frame
from ksim_rl.scene.motions.motion import FASTEST, SLOWEST

Array = np.ndarray


# Two days at 50 per second.
MOST_FRAMES = 10**7


@dataclass(frozen=True, kw_only=True)
class Recording(Checked):
    """N points in F frames, `fps` of them per second; the world's z axis points up.

    Attributes:
        names: of the points.
        pos_FN3: m.
        quat_FN4: (w, x, y, z), unit: the points' frames in the world.
    """

    fps: Positive
    names: tuple[str, ...]
    pos_FN3: Float[Array, "F N 3"]
    quat_FN4: Float[Array, "F N 4"]

    def resampled(self, fps: float) -> "Recording":
        """Return the same at another rate: positions linearly, orientations along the shorter arc."""
        low_F, share_F = between(len(self.pos_FN3), self.fps, fps)
        share_F11 = share_F[:, None, None]
        pos_FN3 = (1.0 - share_F11) * self.pos_FN3[low_F] + share_F11 * self.pos_FN3[low_F + 1]
        quat_FN4 = slerp(self.quat_FN4[low_F], self.quat_FN4[low_F + 1], share_F11)
        return Recording(fps=fps, names=self.names, pos_FN3=pos_FN3, quat_FN4=quat_FN4)


def between(count: int, fps: float, wanted_fps: float) -> tuple[Array, Float[Array, " F"]]:
    """Return for each frame at another rate the frame before it, and the part of the way to the next one.

    A ValueError refuses rates that no recording has, and one so low that its frames would last for days.
    """
    for name, rate in (
        ("frames per second of the recording", fps),
        ("frames per second", wanted_fps),
    ):
        check_in_range(name, rate, low=SLOWEST, high=FASTEST)
    wanted = (count - 1) / fps * wanted_fps
    if wanted > MOST_FRAMES:
        raise ValueError(
            f"{count} frames, {fps:g} of them per second, are {wanted:g} at {wanted_fps:g} per second: expected "
            f"{MOST_FRAMES} at most; repair the rate"
        )
    # The small number keeps the last frame where the division falls just short of it.
    last = int(wanted + 1e-6)
    times_F = np.arange(0, last + 1) / wanted_fps
    # At most the last but one, so that there is always a next frame.
    low_F = np.minimum((times_F * fps + 1e-9).astype(int), count - 2)
    return low_F, np.clip(times_F * fps - low_F, 0.0, 1.0)


def resampled_qpos(
    qpos_FL: Float[Array, "F L"], fps: float, wanted_fps: float
) -> Float[Array, "G L"]:
    """Return the states of a robot with a free root at another rate, as `Recording.resampled` does points."""
    low_F, share_F = between(len(qpos_FL), fps, wanted_fps)
    share_F1 = share_F[:, None]
    before_FL = qpos_FL[low_F]
    after_FL = qpos_FL[low_F + 1]
    # Linear between frames, and the root's orientation along the arc.
    found_FL = (1.0 - share_F1) * before_FL + share_F1 * after_FL
    found_FL[:, 3:7] = slerp(before_FL[:, 3:7], after_FL[:, 3:7], share_F1)
    return found_FL


def slerp(
    first: Float[Array, "*batch 4"],
    second: Float[Array, "*batch 4"],
    share: Float[Array, "*share 1"],
) -> Float[Array, "*batch 4"]:
    """Return unit quaternions on the shorter arc between two, at an even speed."""
    cosine = (first * second).sum(-1, keepdims=True)
    # q and -q are the same orientation: the nearer of the two gives the shorter arc.
    second = np.where(cosine < 0.0, -second, second)
    cosine = np.abs(cosine)
    angle = np.arccos(np.clip(cosine, 0.0, 1.0))
    sine = np.sin(angle)
    # Nearly parallel: the sine would divide by zero, and a straight line is as good.
    is_small = sine < 1e-6
    safe = np.where(is_small, 1.0, sine)
    left = np.where(is_small, 1.0 - share, np.sin((1.0 - share) * angle) / safe)
    right = np.where(is_small, share, np.sin(share * angle) / safe)
    blend = left * first + right * second
    # The linear case leaves the unit sphere a little.
    return blend / np.linalg.norm(blend, axis=-1, keepdims=True)


def multiply(a: Float[Array, "*batch 4"], b: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Return the Hamilton product of quaternions (w, x, y, z)."""
    aw = a[..., :1]
    au = a[..., 1:]
    bw = b[..., :1]
    bu = b[..., 1:]
    scalar = aw * bw - (au * bu).sum(-1, keepdims=True)
    vector = aw * bu + bw * au + np.cross(au, bu)
    return np.concatenate((scalar, vector), axis=-1)


def rotate(q: Float[Array, "*batch 4"], v: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Rotate vectors by quaternions."""
    # v + 2 (w (u x v) + u x (u x v)) with u the vector part: cheaper than two products.
    w = q[..., :1]
    u = q[..., 1:]
    across = np.cross(u, v)
    return v + 2.0 * (w * across + np.cross(u, across))


def from_rotation_vector(turn: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """Return the quaternions of rotation vectors, rad."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    # NumPy's sinc has a pi inside.
    half = 0.5 * np.sinc(angle / (2.0 * np.pi))  # sin(angle / 2) / angle, also at zero
    return np.concatenate((np.cos(0.5 * angle), half * turn), axis=-1)


def chain(
    parents: list[int],
    offsets_N3: Float[Array, "N 3"],
    turns_FN4: Float[Array, "F N 4"],
    root_F3: Float[Array, "F 3"],
) -> tuple[Float[Array, "F N 3"], Float[Array, "F N 4"]]:
    """Return where the joints of a skeleton are: each at its offset from its parent, in whose frame it turns.

    Parents come before their children; the root's parent is -1, and the root is at `root_F3`.
    """
    pos_FN3 = np.zeros((*turns_FN4.shape[:2], 3))
    quat_FN4 = turns_FN4.copy()
    # Parents come first, so theirs are in the world already.
    for joint, parent in enumerate(parents):
        if parent < 0:
            pos_FN3[:, joint] = root_F3
            continue
        quat_FN4[:, joint] = multiply(quat_FN4[:, parent], turns_FN4[:, joint])
        offset_F3 = np.broadcast_to(offsets_N3[joint], root_F3.shape)
        pos_FN3[:, joint] = pos_FN3[:, parent] + rotate(quat_FN4[:, parent], offset_F3)
    return pos_FN3, quat_FN4


def of_robot(mj_model: mujoco.MjModel, qpos_FL: Float[Array, "F L"], fps: float) -> Recording:
    """Return where the bodies of a robot are in a motion of it, by the C engine."""
    pos = []
    quat = []
    for data in in_each_frame(mj_model, qpos_FL):
        # Body 0 is the world.
        pos.append(data.xpos[1:].copy())
        quat.append(data.xquat[1:].copy())
    names = tuple(mj_model.body(i).name for i in range(1, mj_model.nbody))
    return Recording(fps=fps, names=names, pos_FN3=np.array(pos), quat_FN4=np.array(quat))


def refused(path: Path, wrong: str, fix: str) -> ValueError:
    """Return the error for a file that cannot be read as a motion: the fault, and the way out."""
    return ValueError(f"motion {path}: {wrong}: {fix}")
