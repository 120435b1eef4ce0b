"""One robot or object of a scene: its root's pose and velocity, its joints, and where it starts."""

from __future__ import annotations

import mujoco
import torch
from torch import Tensor

from ksim_rl.scene import quaternion
from ksim_rl.scene.names import as_index, scalar_joint_ids
from ksim_rl.scene.state.guarded_state import GuardedState
from ksim_rl.scene.state.quantity import quantity


class Entity:
    """A robot or object, addressed by name: `view.entity("cube").root_pos_EL`.

    The root is the body of the entity's first joint if that is free, else its first body. Poses and velocities are
    those of the current state (position and velocity stage), float32 on the env's device.

    Attributes:
        name: the key in `scene.robots` or `scene.objects`.
        prefix: what stands before the names of its elements; empty if it is alone in the scene.
        root_body: id of the root body; `root_body_name` is its name, `root_index` its index for `view.body_pos_w`.
        free_root: whether the root floats freely.
        joints: index of its hinges and slides into the L dim of `view.joint_pos_EL` and its kin.
        root_qpos, root_qvel: columns of the free joint in qpos (7) and qvel (6); empty if the root is fixed.
        default_root_pos_L, default_root_quat_L: pose of the root at reset, m [3] and (w, x, y, z) [4], world frame.
    """

    def __init__(self, state: GuardedState, *, name: str, prefix: str, default_qpos_L: Tensor) -> None:
        self.cache = state.new_cache()
        self._state = state
        model, device = state.world.mj_model, state.world.device
        self.name, self.prefix = name, prefix
        bodies = [
            b for b in range(1, model.nbody) if model.body(model.body_rootid[b]).name.startswith(prefix)
        ]
        if prefix and not bodies:
            raise ValueError(f"scene: {name!r} has no body: give it one, or put its geoms into the terrain")
        own_bodies = frozenset(bodies)
        joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in own_bodies]
        self.free_root = bool(joints) and model.jnt_type[joints[0]] == mujoco.mjtJoint.mjJNT_FREE
        self.root_body = int(model.jnt_bodyid[joints[0]]) if self.free_root else (bodies or [0])[0]
        self.root_body_name: str = model.body(self.root_body).name
        self.root_index = slice(self.root_body, self.root_body + 1)
        self.root_qpos, self.root_qvel = slice(0, 0), slice(0, 0)
        pose = torch.tensor(
            [*model.body_pos[self.root_body], *model.body_quat[self.root_body]], device=device
        )
        if self.free_root:
            qpos, qvel = int(model.jnt_qposadr[joints[0]]), int(model.jnt_dofadr[joints[0]])
            self.root_qpos, self.root_qvel = slice(qpos, qpos + 7), slice(qvel, qvel + 6)
            pose = default_qpos_L[self.root_qpos]
        self.default_root_pos_L, self.default_root_quat_L = pose.to(torch.float32).split((3, 4))

        self._down = torch.tensor([0.0, 0.0, -1.0], device=device)

        every, own_joints = scalar_joint_ids(model), frozenset(joints)
        own = [position for position, joint in enumerate(every) if joint in own_joints]
        self.joints = as_index(own, device)
        self._joint_qpos = as_index([model.jnt_qposadr[every[i]] for i in own], device)
        self._joint_qvel = as_index([model.jnt_dofadr[every[i]] for i in own], device)

    # -- pose ----------------------------------------------------------------------------------------------------

    @quantity
    def root_pos_EL(self) -> Tensor:
        """Position of the root body's frame in the world, m, [E, 3]."""
        return self._free_qpos(0, 3) if self.free_root else self._state.derived().xpos_EL[:, self.root_body]

    @quantity
    def root_quat_EL(self) -> Tensor:
        """Orientation of the root body, body to world, (w, x, y, z), [E, 4]."""
        return self._free_qpos(3, 7) if self.free_root else self._state.derived().xquat_EL[:, self.root_body]

    @quantity
    def projected_gravity_EL(self) -> Tensor:
        """Unit vector of gravity (world -z) in the root body's frame, [E, 3]."""
        return quaternion.rotate_inverse(self.root_quat_EL, self._down.expand(self._state.world.num_envs, 3))

    @quantity
    def heading_E(self) -> Tensor:
        """Yaw of the root body, rad in [-pi, pi], [E]."""
        return quaternion.yaw(self.root_quat_EL)

    # -- velocity ------------------------------------------------------------------------------------------------

    @quantity
    def root_lin_vel_w_EL(self) -> Tensor:
        """Linear velocity of the root body's frame origin, world frame, m/s, [E, 3]."""
        if self.free_root:
            return self._free_qvel(0, 3)
        pos_E13 = self._state.derived().xpos_EL[:, self.root_index]
        return self._state.point_velocity(pos_E13, self.root_index)[:, 0]

    @quantity
    def root_lin_vel_b_EL(self) -> Tensor:
        """Linear velocity of the root body's frame origin, body frame, m/s, [E, 3]."""
        return quaternion.rotate_inverse(self.root_quat_EL, self.root_lin_vel_w_EL)

    @quantity
    def root_ang_vel_w_EL(self) -> Tensor:
        """Angular velocity of the root body, world frame, rad/s, [E, 3]."""
        if self.free_root:
            return quaternion.rotate(self.root_quat_EL, self.root_ang_vel_b_EL)
        return self._state.derived().cvel_EL[:, self.root_body, 0:3]

    @quantity
    def root_ang_vel_b_EL(self) -> Tensor:
        """Angular velocity of the root body, body frame, rad/s, [E, 3]."""
        if self.free_root:  # MuJoCo keeps a free joint's angular velocity in the body frame
            return self._free_qvel(3, 6)
        return quaternion.rotate_inverse(self.root_quat_EL, self.root_ang_vel_w_EL)

    # -- joints --------------------------------------------------------------------------------------------------

    @quantity
    def joint_pos_EL(self) -> Tensor:
        """Positions of the entity's hinges (rad) and slides (m), in the model's order, [E, L]."""
        return self._state.world.qpos_EL[:, self._joint_qpos]

    @quantity
    def joint_vel_EL(self) -> Tensor:
        """Velocities of the entity's hinges (rad/s) and slides (m/s), in the model's order, [E, L]."""
        return self._state.world.qvel_EL[:, self._joint_qvel]

    # -- writes --------------------------------------------------------------------------------------------------

    def write_root_pose(self, mask_E: Tensor, pos_EL: Tensor, quat_EL: Tensor) -> None:
        """Set position (m) and orientation (w, x, y, z) of the free root body in the rows of `mask_E`.

        Raises:
            ValueError: if the root is fixed.
        """
        self._require_free_root("write_root_pose")
        pose_EL = torch.cat((pos_EL, quat_EL), dim=-1)
        self._state.write(self._state.world.qpos_EL[:, self.root_qpos], mask_E, pose_EL)

    def write_root_velocity(self, mask_E: Tensor, lin_vel_w_EL: Tensor, ang_vel_w_EL: Tensor) -> None:
        """Set the velocities (m/s, rad/s, world frame) of the free root body in the rows of `mask_E`.

        Raises:
            ValueError: if the root is fixed.
        """
        self._require_free_root("write_root_velocity")
        ang_vel_b_EL = quaternion.rotate_inverse(self._free_qpos(3, 7), ang_vel_w_EL)
        velocity_EL = torch.cat((lin_vel_w_EL, ang_vel_b_EL), dim=-1)
        self._state.write(self._state.world.qvel_EL[:, self.root_qvel], mask_E, velocity_EL)

    # -- internals -----------------------------------------------------------------------------------------------

    def _free_qpos(self, start: int, stop: int) -> Tensor:
        first = self.root_qpos.start
        return self._state.world.qpos_EL[:, first + start : first + stop]

    def _free_qvel(self, start: int, stop: int) -> Tensor:
        first = self.root_qvel.start
        return self._state.world.qvel_EL[:, first + start : first + stop]

    def _require_free_root(self, what: str) -> None:
        if not self.free_root:
            raise ValueError(
                f"{what} of {self.name!r}: its root body {self.root_body_name!r} has no free joint"
            )
