"""Reads reference motions: recorded states of a scene, at any time between their frames."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.scene.motions.contents import motion_arrays
from ksim_rl.scene.motions.frames import in_each_frame
from ksim_rl.scene.names import Index, scalar_joint_ids
from ksim_rl.scene.near_names import NearNames

KEYS = ("fps", "qpos", "qvel")
_OPTIONAL = ("joint_names",)
# Frames per second: beyond these, a motion would last for years, or no time at all.
SLOWEST = 1e-2
FASTEST = 1e5


@dataclass(frozen=True, kw_only=True)
class ReferenceMotion(NearNames):
    """F frames of generalized positions and velocities in MuJoCo's layout: of C clips, one after the other.

    Methods take the clip that each env follows; without one it is the first, as of a motion that is a single file.

    Attributes:
        fps: frames per second, of all clips.
        names: of the clips.
        held_out: of the clips, whether training must not see it.
        first_C: the clips' first frames among the F.
        last_C: the number of each clip's last frame, counted from its own first.
        duration_C: seconds from the first frame of each clip to its last.
        duration_s: the longest of them, on the host, where terms read it in each step.
        qpos_FL, qvel_FL: positions and velocities in MuJoCo's layout.
        quats: the columns of qpos at which unit quaternions (w, x, y, z) begin.
        joint_pos_FL: positions of hinges and slides, rad or m.
        joint_vel_FL: velocities of hinges and slides, rad/s or m/s.
        body_pos_FN3: positions of all bodies, the world first, m, world frame.
        body_quat_FN4: orientations of all bodies, the world first, body to world, (w, x, y, z).
    """

    fps: float
    names: tuple[str, ...]
    held_out: tuple[bool, ...]
    first_C: Int64[Tensor, " C"]
    last_C: Float[Tensor, " C"]
    duration_C: Float[Tensor, " C"]
    duration_s: float
    qpos_FL: Float[Tensor, "F ?L"]
    qvel_FL: Float[Tensor, "F ?L"]
    quats: tuple[int, ...]
    joint_pos_FL: Float[Tensor, "F ?L"]
    joint_vel_FL: Float[Tensor, "F ?L"]
    body_pos_FN3: Float[Tensor, "F N 3"]
    body_quat_FN4: Float[Tensor, "F N 4"]

    def duration_of(self, clip_E: Int64[Tensor, " E"] | None) -> Float[Tensor, "*E"]:
        """Return the duration of each env's clip, s."""
        return self.duration_C[0 if clip_E is None else clip_E]

    def sample(
        self, time_E: Float[Tensor, " E"], clip_E: Int64[Tensor, " E"] | None = None
    ) -> tuple[Float[Tensor, "E L"], Float[Tensor, "E M"]]:
        """Return qpos and qvel at times, s; before the first and after the last frame of a clip those stay.

        Between frames both are interpolated linearly, quaternions along the shorter arc and normalized.
        """
        # Frame and share once, for all tables.
        low_E, share_E1 = self.between(time_E, clip_E)
        before_EL = self.qpos_FL[low_E]
        after_EL = self.qpos_FL[low_E + 1]
        qpos_EL = torch.lerp(before_EL, after_EL, share_E1)
        # A mean of quaternions has to be normalized, and may have to take the other sign.
        for start in self.quats:
            columns = slice(start, start + 4)
            qpos_EL[:, columns] = _blend(before_EL[:, columns], after_EL[:, columns], share_E1)
        return qpos_EL, torch.lerp(self.qvel_FL[low_E], self.qvel_FL[low_E + 1], share_E1)

    def sample_joints(
        self,
        time_E: Float[Tensor, " E"],
        joints: Index,
        clip_E: Int64[Tensor, " E"] | None = None,
    ) -> tuple[Float[Tensor, "E N"], Float[Tensor, "E N"]]:
        """Return positions and velocities of hinges and slides at times, s."""
        low_E, share_E1 = self.between(time_E, clip_E)
        pos_EL, vel_EL = (
            torch.lerp(
                _entries(table_FL, low_E, joints), _entries(table_FL, low_E + 1, joints), share_E1
            )
            for table_FL in (self.joint_pos_FL, self.joint_vel_FL)
        )
        return pos_EL, vel_EL

    def sample_bodies(
        self,
        time_E: Float[Tensor, " E"],
        bodies: Index,
        clip_E: Int64[Tensor, " E"] | None = None,
    ) -> tuple[Float[Tensor, "E N 3"], Float[Tensor, "E N 4"]]:
        """Return the poses of bodies at times, s; between frames as in `sample`."""
        low_E, share_E1 = self.between(time_E, clip_E)
        (pos_EN3, next_pos_EN3), (quat_EN4, next_quat_EN4) = (
            (_entries(table, low_E, bodies), _entries(table, low_E + 1, bodies))
            for table in (self.body_pos_FN3, self.body_quat_FN4)
        )
        # [E, 1, 1], to broadcast over bodies and numbers.
        share_E11 = share_E1[:, None]
        return torch.lerp(pos_EN3, next_pos_EN3, share_E11), _blend(
            quat_EN4, next_quat_EN4, share_E11
        )

    def between(
        self, time_E: Float[Tensor, " E"], clip_E: Int64[Tensor, " E"] | None = None
    ) -> tuple[Int64[Tensor, " E"], Float[Tensor, "E 1"]]:
        """Return the frame before each time, s, among the F, and the part of the way to the next one."""
        clip = 0 if clip_E is None else clip_E
        last_E = self.last_C[clip]
        frame_E = torch.minimum((time_E * self.fps).clamp(min=0.0), last_E)
        # The last frame has no next one: the share is 1 there instead. So no clip reads the next one's frames.
        low_E = torch.minimum(frame_E.floor(), last_E - 1.0)
        return self.first_C[clip] + low_E.long(), (frame_E - low_E)[:, None]


def motion_path(file: str) -> Path:
    """Return where a motion of this name lies in the package or, if there is none of this name, `file` as a path."""
    # A name, not a path: a file may not lie outside of the package's folder.
    shipped = Path(__file__).parent / f"{file}.npz"
    if shipped.is_file() and shipped.parent == Path(__file__).parent:
        return shipped
    return Path(file)


def load_motion(
    file: str | Path, mj_model: mujoco.MjModel, device: torch.device
) -> ReferenceMotion:
    """Read an .npz file of the model: `fps`, `qpos` [F, nq], `qvel` [F, nv] and, if it has them, `joint_names`.

    The file may be the name of a motion that comes with the package (`ksim_rl.scene.motions`).
    """
    return load_clips({Path(str(file)).stem: str(file)}, mj_model, device)


def load_clips(
    files: Mapping[str, str],
    mj_model: mujoco.MjModel,
    device: torch.device,
    *,
    held_out: Collection[str] = (),
) -> ReferenceMotion:
    """Read motions by name, as `load_motion` does each, into one table; the clips of `held_out` are marked as such."""
    clips = [_checked_arrays(file, mj_model) for file in files.values()]
    rates = [float(arrays["fps"].item()) for arrays in clips]
    for file, fps in zip(files.values(), rates, strict=True):
        # One table has one rate: a clip of another one is resampled when it is made.
        if fps != rates[0]:
            first = next(iter(files.values()))
            raise ValueError(
                f"motion {file}: fps={fps:g}, and {first} has {rates[0]:g}: motions of one folder have one rate; make "
                f"it with --fps {rates[0]:g}"
            )
    counts = [len(arrays["qpos"]) for arrays in clips]
    qpos_FL = np.concatenate([arrays["qpos"] for arrays in clips])
    qvel_FM = np.concatenate([arrays["qvel"] for arrays in clips])
    # Bodies follow from qpos by kinematics, once on the host.
    body_pos_FN3, body_quat_FN4 = _body_poses(mj_model, qpos_FL)
    joints = scalar_joint_ids(mj_model)

    def on_device(array: np.ndarray | list[float]) -> Tensor:
        return torch.tensor(array, dtype=torch.float32, device=device)

    firsts = np.cumsum([0, *counts[:-1]])
    return ReferenceMotion(
        fps=rates[0],
        names=tuple(files),
        held_out=tuple(name in held_out for name in files),
        first_C=torch.tensor(firsts, dtype=torch.int64, device=device),
        last_C=on_device([count - 1.0 for count in counts]),
        duration_C=on_device([(count - 1) / rates[0] for count in counts]),
        duration_s=(max(counts) - 1) / rates[0],
        qpos_FL=on_device(qpos_FL),
        qvel_FL=on_device(qvel_FM),
        quats=_quaternion_columns(mj_model),
        joint_pos_FL=on_device(qpos_FL[:, mj_model.jnt_qposadr[joints]]),
        joint_vel_FL=on_device(qvel_FM[:, mj_model.jnt_dofadr[joints]]),
        body_pos_FN3=on_device(body_pos_FN3),
        body_quat_FN4=on_device(body_quat_FN4),
    )


def _quaternion_columns(mj_model: mujoco.MjModel) -> tuple[int, ...]:
    """Return the columns of qpos at which quaternions begin."""
    # Where a joint's quaternion starts in its part of qpos; a free joint has its position before it.
    starts = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}
    places = zip(mj_model.jnt_type.tolist(), mj_model.jnt_qposadr.tolist(), strict=True)
    return tuple(address + starts[kind] for kind, address in places if kind in starts)


def _checked_arrays(file: str, mj_model: mujoco.MjModel) -> Mapping[str, np.ndarray]:
    """Return the arrays of a file that fits the model; a ValueError names what does not."""
    arrays = _read(motion_path(file))
    # One number, also as an array.
    fps = arrays["fps"]
    if fps.size != 1 or not SLOWEST <= fps.item() <= FASTEST:
        raise ValueError(
            f"motion {file}: fps={fps.tolist()!r}: expected one number of frames per second, {SLOWEST:g} to {FASTEST:g}"
        )
    for key, width, kind in (("qpos", mj_model.nq, "nq"), ("qvel", mj_model.nv, "nv")):
        array = arrays[key]
        if array.ndim != 2 or array.shape[1] != width or array.shape[0] < 2:
            raise ValueError(
                f"motion {file}: {key} has shape {array.shape}: expected [F, {width}] ({kind} of the model), F >= 2"
            )
        # As float32, in which they are kept: a larger number becomes infinite there.
        with np.errstate(over="ignore"):
            is_finite = np.isfinite(array.astype(np.float32)).all()
        if not is_finite:
            raise ValueError(f"motion {file}: {key} holds a number that is not finite in float32")
    if arrays["qpos"].shape[0] != arrays["qvel"].shape[0]:
        raise ValueError(
            f"motion {file}: qpos has {arrays['qpos'].shape[0]} frames and qvel {arrays['qvel'].shape[0]}"
        )
    # Optional: a guard against a file for another robot or another order.
    names = arrays.get("joint_names")
    if names is not None and names.ndim != 1:
        raise ValueError(
            f"motion {file}: joint_names has shape {names.shape}: expected one name for each joint"
        )
    own = [mj_model.joint(i).name for i in range(mj_model.njnt)]
    for name in () if names is None else names:
        if name not in own:
            raise ValueError(
                f"motion {file}: the model has no joint {str(name)!r}: {near(str(name), own)}"
            )
    if names is not None and [str(name) for name in names] != own:
        raise ValueError(
            f"motion {file}: joint_names={names.tolist()}: expected the model's joints in their order, {own}"
        )
    for start in _quaternion_columns(mj_model):
        # Float32 files round; a thousandth is far beyond that.
        norms = np.linalg.norm(arrays["qpos"][:, start : start + 4], axis=-1)
        if np.abs(norms - 1.0).max() > 1e-3:
            raise ValueError(
                f"motion {file}: qpos[:, {start}:{start + 4}] holds quaternions of lengths {norms.min():g} to "
                f"{norms.max():g}: expected unit quaternions (w, x, y, z)"
            )
    return arrays


def _read(path: Path) -> Mapping[str, np.ndarray]:
    if not path.exists():
        shipped = ", ".join(sorted(own.stem for own in Path(__file__).parent.glob("*.npz")))
        raise ValueError(
            f"motion {path}: no such file, and none of that name comes with the package: {shipped}"
        )
    try:
        # Without pickles, since these run code when they are read.
        arrays = motion_arrays(path)
    except ValueError as error:
        raise ValueError(
            f"motion {path}: cannot be read as .npz without pickles: {error}"
        ) from None
    for key in KEYS:
        if key not in arrays:
            raise ValueError(
                f"motion {path}: no array {key!r}: it has {', '.join(sorted(arrays)) or 'none'}"
            )
        # Torch has no numbers of more than 64 bits.
        if arrays[key].dtype.kind not in "fiu" or arrays[key].dtype.itemsize > 8:
            raise ValueError(
                f"motion {path}: {key} is {arrays[key].dtype}: expected numbers of at most 64 bits"
            )
    unknown = sorted(arrays.keys() - {*KEYS, *_OPTIONAL})
    if unknown:
        raise ValueError(
            f"motion {path}: unknown array {unknown[0]!r}: {near(unknown[0], (*KEYS, *_OPTIONAL))}"
        )
    return arrays


def _entries(table: Tensor, frame_E: Int64[Tensor, " E"], columns: Index) -> Tensor:
    """Return some columns of a table [F, N, ...] in each env's frame, [E, N, ...]."""
    # A slice is a view: columns first, then one gather.
    if isinstance(columns, slice):
        return table[:, columns][frame_E]
    return table[frame_E[:, None], columns]


def _blend(first: Tensor, second: Tensor, share: Tensor) -> Tensor:
    """Return unit quaternions [..., 4] between two, along the shorter arc."""
    # A quaternion and its negative are the same orientation; the shorter arc has a positive dot product.
    sign = torch.where((first * second).sum(-1, keepdim=True) < 0.0, -1.0, 1.0)
    blend = torch.lerp(first, sign * second, share)
    return blend / torch.linalg.vector_norm(blend, dim=-1, keepdim=True)


def _body_poses(mj_model: mujoco.MjModel, qpos_FL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the bodies are in each frame, [F, N, 3] and [F, N, 4]."""
    pos_FN3 = []
    quat_FN4 = []
    for data in in_each_frame(mj_model, qpos_FL):
        pos_FN3.append(data.xpos.copy())
        quat_FN4.append(data.xquat.copy())
    return np.stack(pos_FN3), np.stack(quat_FN4)
