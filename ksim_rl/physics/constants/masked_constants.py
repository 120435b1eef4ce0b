"""Recomputes the constants that follow from model fields in some worlds only, as a reset needs it.

`mujoco_warp.set_const` recomputes all worlds, with one solve per dof and six per body: hundreds of launches. Here it is
one launch, and worlds outside of the mask cost an early return.
"""

from collections.abc import Iterable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics.constants import constant_kernels as kernels
from ksim_rl.physics.constants.least_weights import raising_of_weights
from ksim_rl.physics.fields import FIXED, INERT0, KIN0, const_groups
from ksim_rl.physics.rows.tie_weights import BODY_EQUALITIES
from ksim_rl.physics.structs import filled
from ksim_rl.physics.upstream import set_fixed_constants

KINEMATIC = frozenset(("qpos0", "body_pos", "body_quat", "jnt_pos", "jnt_axis"))
_JOINT_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
# What `body_simple` says of a body that has slides only, along axes of the world, and carries no other.
SLIDES_ALONE = 2
LANES = 128  # threads that share the work of one world on a GPU: a block
# Of the 48 KiB of shared memory that any block has, some is Warp's.
_MOST_FLOATS_IN_SHARED = 40 * 1024 // 4
_SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


class MaskedConstants:
    """Launches for the worlds of a mask, on memory of its own: 48 nbody bytes per world, and on the CPU, or where
    shared memory has no room for it, 8 nv^2 + 36 nv + 108 nbody more.

    Build it once the model's arrays are in their final place, on the device of the model.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        warp_model: mjw.Model,
        mask: wp.array,
        expanded: Iterable[str],
    ) -> None:
        self._mj_model = mj_model
        self._warp_model = warp_model
        self._moves = KINEMATIC & set(expanded)
        self._resizes = "geom_size" in expanded
        # Weights of tendons, flexes and other transmissions are not computed by the kernel.
        self._inert = (
            not mj_model.ntendon and not mj_model.nflex and _drives_scalar_joints(mj_model)
        )
        self._ties_bodies = (
            bool(np.isin(mj_model.eq_type, BODY_EQUALITIES).any()) or mj_model.ntendon > 0
        )
        has_armature = "actuator_armature" in expanded or np.any(mj_model.actuator_armature)
        self._num_envs = num_envs = mask.shape[0]
        nbody = mj_model.nbody
        nv = mj_model.nv
        starts, sizes = _joint_groups(mj_model)
        self._lanes = LANES if mask.device.is_cuda else 1
        floats = kernels.floats_per_world(nv, nbody)
        in_shared = mask.device.is_cuda and floats <= _MOST_FLOATS_IN_SHARED
        self._kernel = kernels.constants_kernel(nv, nbody, self._lanes, in_shared)
        # Frames at qpos0 are shared unless a field that moves them differs between worlds.
        num_frames = num_envs if self._moves else 1
        self._mask = mask
        self._raise_weights = raising_of_weights(mj_model, warp_model)
        # The mask of `place_frames`, which runs for all frames.
        self._everywhere = wp.full(num_frames, True, dtype=bool)
        own = {
            "mask": mask,
            "sums_masses": "body_subtreemass" in expanded,
            # Without armature, actuators add nothing to the inertia matrix.
            "num_actuators": mj_model.nu if has_armature else 0,
            "dof_rotates": wp.array(_rotates(mj_model), dtype=float),
            "group_start": wp.array(starts, dtype=int),
            "group_size": wp.array(sizes, dtype=int),
            "slides_alone": wp.array(mj_model.body_simple == SLIDES_ALONE, dtype=bool),
            "last_dof": wp.array(_last_dofs(mj_model), dtype=int),
            "actuator_dof": wp.array(_driven_dofs(mj_model), dtype=int),
            "xpos": wp.zeros((num_frames, nbody), dtype=wp.vec3),
            "xquat": wp.zeros((num_frames, nbody), dtype=wp.quat),
            "anchor": wp.zeros((num_frames, nv), dtype=wp.vec3),
            "axis": wp.zeros((num_frames, nv), dtype=wp.vec3),
            "xipos": wp.zeros((num_envs, nbody), dtype=wp.vec3),
            "inertia": wp.zeros((num_envs, nbody), dtype=wp.mat33),
            # One row where shared memory holds it, since a kernel takes an array in any case.
            "scratch": wp.zeros((1 if in_shared else num_envs, floats), dtype=float),
        }
        self._constants = filled(kernels.Constants, own, warp_model)

    def place_frames(self) -> None:
        """Launch the frames at `qpos0` of all worlds, which must have run once before `launch`."""
        self._constants.mask = self._everywhere
        wp.launch(kernels.frames, dim=self._everywhere.shape[0], inputs=[self._constants])
        self._constants.mask = self._mask

    def mend_weights(self) -> None:
        """Launch the kernel that gives all worlds the inverse weights of C after `mujoco_warp.set_const`."""
        self.place_frames()
        wp.launch(kernels.mend_weights, dim=self._constants.xipos.shape, inputs=[self._constants])
        self._raise_weights()

    def covers(self, fields: Iterable[str]) -> bool:
        """Return whether the constants that follow from `fields` can be recomputed here, as `World.set_const` says."""
        fields = set(fields)
        groups = const_groups(fields, self._mj_model)
        # Anchors of ties, and lengths of tendons, follow from frames.
        moves = bool(fields & (KINEMATIC | {"eq_data"}))
        return (self._inert or not groups & INERT0) and not (moves and self._ties_bodies)

    def launch(self, groups: int) -> None:
        """Launch the constants of `groups` in the rows of the mask."""
        if groups & FIXED and self._resizes:
            # Cheap, and the same bits again in rows whose fields did not change.
            set_fixed_constants(self._warp_model)
        if not groups & (KIN0 | INERT0):
            return
        # Frames that all worlds share stay as `place_frames` left them.
        if self._moves:
            wp.launch(kernels.frames, dim=self._num_envs, inputs=[self._constants])
        dim = (self._num_envs, self._lanes)
        inputs = [self._constants, groups]
        wp.launch(self._kernel, dim=dim, inputs=inputs, block_dim=self._lanes)
        if groups & INERT0:
            self._raise_weights()


def _drives_scalar_joints(mj_model: mujoco.MjModel) -> bool:
    on_joints = np.isin(mj_model.actuator_trntype, _JOINT_TRANSMISSIONS).all()
    return bool(
        on_joints
        and np.isin(mj_model.jnt_type[mj_model.actuator_trnid[:, 0]], _SCALAR_JOINTS).all()
    )


def _driven_dofs(mj_model: mujoco.MjModel) -> np.ndarray:
    # MuJoCo Warp computes these models' constants; no table is needed.
    if not _drives_scalar_joints(mj_model):
        return np.zeros(0, dtype=int)
    return mj_model.jnt_dofadr[mj_model.actuator_trnid[:, 0]]


def _rotates(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return 1 for each dof that turns, 0 for each that slides, [nv]."""
    slides = mj_model.jnt_type[mj_model.dof_jntid] == mujoco.mjtJoint.mjJNT_SLIDE
    return 1.0 - (slides | (_free_offset(mj_model) // 3 == 0))


def _free_offset(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return each dof's place within its free joint, or a place beyond, [nv]."""
    free = mj_model.jnt_type[mj_model.dof_jntid] == mujoco.mjtJoint.mjJNT_FREE
    offset = np.arange(mj_model.nv) - mj_model.jnt_dofadr[mj_model.dof_jntid]
    return np.where(free, offset, 6)


def _joint_groups(mj_model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return for each dof the first one, and the number, of those whose inverse weights are averaged."""
    kind = mj_model.jnt_type[mj_model.dof_jntid]
    triple = np.isin(kind, (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL))
    # The rotations of a free joint, whose translations are averaged apart from them.
    second = _free_offset(mj_model) // 3 == 1
    start = np.where(
        triple, mj_model.jnt_dofadr[mj_model.dof_jntid] + 3 * second, np.arange(mj_model.nv)
    )
    return start, np.where(triple, 3, 1)


def _last_dofs(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the last dof that moves each body, -1 for none, [nbody]."""
    last = np.full(mj_model.nbody, -1)
    for body in range(1, mj_model.nbody):
        count = mj_model.body_dofnum[body]
        # A body without joints moves as its parent does.
        own = mj_model.body_dofadr[body] + count - 1
        last[body] = own if count else last[mj_model.body_parentid[body]]
    return last
