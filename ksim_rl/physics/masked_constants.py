"""The constants that follow from model fields, recomputed in some worlds only: what a reset needs.

`mujoco_warp.set_const` recomputes all worlds, with one solve per dof and six per body: hundreds of launches. Here the
work is a handful of launches, and worlds outside of the mask cost an early return.
"""

from collections.abc import Iterable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import constant_kernels as kernels
from ksim_rl.physics.fields import FIXED, INERT0, KIN0, const_groups
from ksim_rl.physics.upstream import set_fixed_constants

KINEMATIC = frozenset(("qpos0", "body_pos", "body_quat", "jnt_pos", "jnt_axis"))
_JOINT_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_BODY_EQUALITIES = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)


class MaskedConstants:
    """Launches for the worlds of a mask, on scratch memory of its own: 4 nv^2 + 60 nbody bytes per world.

    Build it once the model's arrays are in their final place, on the device of the model.
    """

    def __init__(
        self, mj_model: mujoco.MjModel, warp_model: mjw.Model, mask: wp.array, expanded: Iterable[str]
    ) -> None:
        self._model = warp_model
        self._mask = mask
        self._moves = KINEMATIC & set(expanded)
        self._inert = not mj_model.ntendon and not mj_model.nflex and _drives_scalar_joints(mj_model)
        self._ties_bodies = bool(np.isin(mj_model.eq_type, _BODY_EQUALITIES).any()) or mj_model.ntendon > 0
        has_armature = "actuator_armature" in expanded or np.any(mj_model.actuator_armature)
        self._num_armatures = mj_model.nu if has_armature else 0
        num_envs, nbody, nv = mask.shape[0], mj_model.nbody, mj_model.nv

        self._rotates = wp.array(_rotates(mj_model), dtype=float)
        starts, sizes = _joint_groups(mj_model)
        self._group_start, self._group_size = wp.array(starts, dtype=int), wp.array(sizes, dtype=int)
        self._last_dof = wp.array(_last_dofs(mj_model), dtype=int)
        self._actuator_dof = wp.array(_driven_dofs(mj_model), dtype=int)

        # Frames at qpos0 are shared unless a field that moves them differs between worlds.
        frames = num_envs if self._moves else 1
        self._xpos = wp.zeros((frames, nbody), dtype=wp.vec3)
        self._xquat = wp.zeros((frames, nbody), dtype=wp.quat)
        self._anchor = wp.zeros((frames, nv), dtype=wp.vec3)
        self._axis = wp.zeros((frames, nv), dtype=wp.vec3)
        self._xipos = wp.zeros((num_envs, nbody), dtype=wp.vec3)
        self._inertia = wp.zeros((num_envs, nbody), dtype=wp.mat33)
        self._factor = wp.zeros((num_envs, nv, nv), dtype=float)
        self._launch_frames(wp.full(frames, True, dtype=bool))

    def covers(self, fields: Iterable[str]) -> bool:
        """Return whether the constants that follow from `fields` can be recomputed here.

        Not for models with tendons or flexes or with actuators on anything but hinges and slides (where inertia
        matters), nor for moved frames of bodies that equality constraints tie.
        """
        fields = set(fields)
        groups = const_groups(fields)
        moves = bool(fields & (KINEMATIC | {"eq_data"}))
        return (self._inert or not groups & INERT0) and not (moves and self._ties_bodies)

    def launch(self, groups: int) -> None:
        """Launch what recomputes the constants of `groups` in the rows of the mask."""
        m, mask, num_envs = self._model, self._mask, self._mask.shape[0]
        if groups & FIXED:
            # Cheap, and the same bits again in rows whose fields did not change.
            set_fixed_constants(m)
        if not groups & (KIN0 | INERT0):
            return
        if self._moves:
            self._launch_frames(mask)
        wp.launch(
            kernels.inertias,
            dim=(num_envs, m.nbody),
            inputs=[mask, m.body_inertia, m.body_ipos, m.body_iquat, self._xpos, self._xquat],
            outputs=[self._xipos, self._inertia],
        )
        if groups & KIN0:
            self._launch_references()
        if groups & INERT0:
            self._launch_invweights()

    def _launch_frames(self, mask: wp.array) -> None:
        m = self._model
        tree = [m.qpos0, m.body_parentid, m.body_jntnum, m.body_jntadr, m.body_pos, m.body_quat]
        joints = [m.jnt_type, m.jnt_qposadr, m.jnt_dofadr, m.jnt_pos, m.jnt_axis]
        wp.launch(
            kernels.frames,
            dim=mask.shape[0],
            inputs=[mask, m.nbody, *tree, *joints],
            outputs=[self._xpos, self._xquat, self._anchor, self._axis],
        )

    def _launch_invweights(self) -> None:
        m, mask, num_envs = self._model, self._mask, self._mask.shape[0]
        if not m.nv:
            return
        dofs, actuators = (num_envs, m.nv), [self._actuator_dof, m.actuator_armature, m.actuator_gear]
        places = [self._anchor, self._axis, self._xipos]
        wp.launch(
            kernels.mass_matrix,
            dim=dofs,
            inputs=[
                *(mask, self._num_armatures, m.dof_bodyid, m.dof_parentid, self._rotates, m.body_subtreenum),
                *(m.body_mass, m.dof_armature, *actuators, *places, self._inertia),
            ],
            outputs=[self._factor],
        )
        wp.launch(
            kernels.factorize, dim=num_envs, inputs=[mask, m.nv, m.dof_parentid], outputs=[self._factor]
        )
        wp.launch(kernels.invert, dim=dofs, inputs=[mask, m.dof_parentid], outputs=[self._factor])
        wp.launch(
            kernels.dof_invweights,
            dim=dofs,
            inputs=[mask, m.dof_parentid, self._group_start, self._group_size, self._factor],
            outputs=[m.dof_invweight0],
        )
        wp.launch(
            kernels.body_invweights,
            dim=(num_envs, m.nbody),
            inputs=[mask, m.dof_parentid, self._rotates, self._last_dof, *places, self._factor],
            outputs=[m.body_invweight0],
        )
        wp.launch(
            kernels.actuator_accelerations,
            dim=(num_envs, self._actuator_dof.shape[0]),
            inputs=[mask, m.nv, m.dof_parentid, self._actuator_dof, m.actuator_gear, self._factor],
            outputs=[m.actuator_acc0],
        )

    def _launch_references(self) -> None:
        m, mask, num_envs = self._model, self._mask, self._mask.shape[0]
        masses = [m.body_subtreenum, m.body_mass, self._xpos, self._xquat, self._xipos]
        wp.launch(
            kernels.camera_references,
            dim=(num_envs, m.ncam),
            inputs=[mask, m.cam_bodyid, m.cam_targetbodyid, m.cam_pos, m.cam_quat, *masses],
            outputs=[m.cam_pos0, m.cam_poscom0, m.cam_mat0],
        )
        wp.launch(
            kernels.light_references,
            dim=(num_envs, m.nlight),
            inputs=[mask, m.light_bodyid, m.light_targetbodyid, m.light_pos, m.light_dir, *masses],
            outputs=[m.light_pos0, m.light_poscom0, m.light_dir0],
        )


def _drives_scalar_joints(mj_model: mujoco.MjModel) -> bool:
    on_joints = np.isin(mj_model.actuator_trntype, _JOINT_TRANSMISSIONS).all()
    return bool(on_joints and np.isin(mj_model.jnt_type[mj_model.actuator_trnid[:, 0]], _SCALAR_JOINTS).all())


def _driven_dofs(mj_model: mujoco.MjModel) -> np.ndarray:
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
    second = _free_offset(mj_model) // 3 == 1
    start = np.where(triple, mj_model.jnt_dofadr[mj_model.dof_jntid] + 3 * second, np.arange(mj_model.nv))
    return start, np.where(triple, 3, 1)


def _last_dofs(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the last dof that moves each body, -1 for none, [nbody]."""
    last = np.full(mj_model.nbody, -1)
    for body in range(1, mj_model.nbody):
        count = mj_model.body_dofnum[body]
        own = mj_model.body_dofadr[body] + count - 1
        last[body] = own if count else last[mj_model.body_parentid[body]]
    return last
