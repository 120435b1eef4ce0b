"""What terms read: named quantities of the current state, each computed at most once per step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from ksim_rl import random
from ksim_rl.checks import near
from ksim_rl.envs import quaternion
from ksim_rl.envs.memory import Memory
from ksim_rl.envs.names import Index, NameResolver, Patterns, as_index, scalar_joint_ids
from ksim_rl.envs.sensors import ContactState, ContactTracker
from ksim_rl.physics import World


def quantity(compute: Callable[[Any], Tensor]) -> property:
    """Make a property that is computed at most once between two changes of the state."""
    name = compute.__name__

    def read(view: EnvView) -> Tensor:
        value = view.cache.get(name)
        if value is None:
            value = view.cache[name] = compute(view)
        return value

    return property(read, doc=compute.__doc__)


class EnvView:
    """A typed view of the world for terms.

    Position- and velocity-stage quantities (poses, velocities, most sensors) are those of the current state.
    Acceleration-stage ones (contact sensors, accelerometers, actuator forces) belong to the last physics substep, and
    read zero in rows that were just reset. All values are float32 on the env's device unless stated otherwise.
    """

    def __init__(
        self,
        world: World,
        *,
        step_dt: float,
        max_episode_length: int = 0,
        soft_joint_pos_limit_factor: float = 1.0,
    ) -> None:
        model = world.mj_model
        self.max_episode_length = max_episode_length
        self.world = world
        self.num_envs, self.device = world.num_envs, world.device
        self.physics_dt, self.step_dt = float(model.opt.timestep), step_dt
        self.resolver = NameResolver(model, world.device)
        self.cache: dict[str, Tensor] = {}
        self.memories = Memory(world.num_envs, world.device)
        self.contacts: dict[str, ContactTracker] = {}
        self.commands: dict[str, Tensor] = {}
        self.reward_weights: dict[str, Tensor] = {}

        joints = scalar_joint_ids(model)
        self._qpos_index = as_index([model.jnt_qposadr[j] for j in joints], self.device)
        self._qvel_index = as_index([model.jnt_dofadr[j] for j in joints], self.device)
        self.num_joints = len(joints)
        self._free = bool(model.njnt) and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
        self._root_body = int(model.jnt_bodyid[0]) if self._free else min(1, model.nbody - 1)
        self._body_root = torch.tensor(model.body_rootid, device=self.device, dtype=torch.int64)
        self._site_body = torch.tensor(model.site_bodyid, device=self.device, dtype=torch.int64)
        self._sensor_slices = {
            model.sensor(i).name: slice(
                int(model.sensor_adr[i]), int(model.sensor_adr[i] + model.sensor_dim[i])
            )
            for i in range(model.nsensor)
        }
        self._gravity_direction = torch.tensor([0.0, 0.0, -1.0], device=self.device)

        default_qpos = torch.tensor(
            model.key_qpos[0] if model.nkey else model.qpos0, device=self.device, dtype=torch.float32
        )
        self.default_qpos_L = default_qpos
        self.default_joint_pos_EL = default_qpos[self._qpos_index].expand(self.num_envs, -1).clone()
        ctrl_range = torch.tensor(model.actuator_ctrlrange, device=self.device, dtype=torch.float32)
        self.ctrl_limits_L2 = self._limited(ctrl_range.view(-1, 2), model.actuator_ctrllimited)
        self.soft_joint_pos_limits_L2 = self._soft_limits(joints, soft_joint_pos_limit_factor)
        self.time_out_offset_E = self.memories.get("time_out_offset_E", dtype=torch.int64)
        self.encoder_bias_EL = self.memories.get("encoder_bias_EL", self.num_joints, keep=True)

        zero = torch.zeros((), dtype=torch.int64, device=self.device)
        self.seed = zero.clone()
        self.step_count = zero.clone()
        self.reset_count_E = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self.episode_step_E = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self.action_EL = torch.zeros(self.num_envs, 0, device=self.device)
        self.last_action_EL = torch.zeros(self.num_envs, 0, device=self.device)
        self.startup_counter = zero
        self._counter: Tensor = zero
        self._stale = False
        self._persistent: set[int] = set()
        self._scope, self._draw_scope, self._draws = "", "", 0

    # -- names ---------------------------------------------------------------------------------------------------

    def joints(self, patterns: Patterns) -> Index:
        """Return the index of matching hinges and slides into the L dim of `joint_pos_EL` and its kin."""
        return self.resolver.index("joint", patterns)

    def joint_names(self, patterns: Patterns = ".*") -> list[str]:
        """Return the names of the matching hinges and slides, in the order that `joints` gives."""
        names = self.resolver.names("joint")
        return [names[i] for i in self.resolver.ids("joint", patterns)]

    def bodies(self, patterns: Patterns) -> Index:
        """Return the index of matching bodies."""
        return self.resolver.index("body", patterns)

    def geoms(self, patterns: Patterns) -> Index:
        """Return the index of matching geoms."""
        return self.resolver.index("geom", patterns)

    def sites(self, patterns: Patterns) -> Index:
        """Return the index of matching sites."""
        return self.resolver.index("site", patterns)

    def actuators(self, patterns: Patterns) -> Index:
        """Return the index of matching actuators."""
        return self.resolver.index("actuator", patterns)

    # -- joints --------------------------------------------------------------------------------------------------

    @quantity
    def joint_pos_EL(self) -> Tensor:
        """Positions of the hinges (rad) and slides (m), in the model's order, [E, L]."""
        return self.world.qpos_EL[:, self._qpos_index]

    @quantity
    def joint_vel_EL(self) -> Tensor:
        """Velocities of the hinges (rad/s) and slides (m/s), in the model's order, [E, L]."""
        return self.world.qvel_EL[:, self._qvel_index]

    @quantity
    def joint_acc_EL(self) -> Tensor:
        """Accelerations of the hinges (rad/s^2) and slides (m/s^2); acceleration stage, [E, L]."""
        return self.world.qacc_EL[:, self._qvel_index]

    @quantity
    def joint_pos_rel_EL(self) -> Tensor:
        """Joint positions minus the default pose, [E, L]."""
        return self.joint_pos_EL - self.default_joint_pos_EL

    # -- root ----------------------------------------------------------------------------------------------------

    @quantity
    def root_pos_EL(self) -> Tensor:
        """Position of the root body's frame in the world, m, [E, 3]."""
        return self.world.qpos_EL[:, 0:3] if self._free else self._derived().xpos_EL[:, self._root_body]

    @quantity
    def root_quat_EL(self) -> Tensor:
        """Orientation of the root body, body to world, (w, x, y, z), [E, 4]."""
        return self.world.qpos_EL[:, 3:7] if self._free else self._derived().xquat_EL[:, self._root_body]

    @quantity
    def root_lin_vel_w_EL(self) -> Tensor:
        """Linear velocity of the root body's frame origin, world frame, m/s, [E, 3]."""
        return self.world.qvel_EL[:, 0:3] if self._free else self.body_lin_vel_w(self._root_slice)[:, 0]

    @quantity
    def root_ang_vel_w_EL(self) -> Tensor:
        """Angular velocity of the root body, world frame, rad/s, [E, 3]."""
        if self._free:
            return quaternion.rotate(self.root_quat_EL, self.root_ang_vel_b_EL)
        return self._derived().cvel_EL[:, self._root_body, 0:3]

    @quantity
    def root_lin_vel_b_EL(self) -> Tensor:
        """Linear velocity of the root body's frame origin, body frame, m/s, [E, 3]."""
        return quaternion.rotate_inverse(self.root_quat_EL, self.root_lin_vel_w_EL)

    @quantity
    def root_ang_vel_b_EL(self) -> Tensor:
        """Angular velocity of the root body, body frame, rad/s, [E, 3]."""
        if self._free:  # MuJoCo keeps a free joint's angular velocity in the body frame
            return self.world.qvel_EL[:, 3:6]
        return quaternion.rotate_inverse(self.root_quat_EL, self.root_ang_vel_w_EL)

    @quantity
    def projected_gravity_EL(self) -> Tensor:
        """Unit vector of gravity (world -z) in the root body's frame, [E, 3]."""
        return quaternion.rotate_inverse(self.root_quat_EL, self._gravity_direction.expand(self.num_envs, 3))

    @quantity
    def heading_E(self) -> Tensor:
        """Yaw of the root body, rad in [-pi, pi], [E]."""
        return quaternion.yaw(self.root_quat_EL)

    # -- bodies and sites ----------------------------------------------------------------------------------------

    def body_pos_w(self, index: Index) -> Tensor:
        """Return positions of body frames in the world, m, [E, N, 3]."""
        return self._derived().xpos_EL[:, index]

    def body_lin_vel_w(self, index: Index) -> Tensor:
        """Return linear velocities of body frame origins, world frame, m/s, [E, N, 3]."""
        return self._point_velocity(self._derived().xpos_EL[:, index], index, self._body_root[index])

    def body_ang_vel_w(self, index: Index) -> Tensor:
        """Return angular velocities of bodies, world frame, rad/s, [E, N, 3]."""
        return self._derived().cvel_EL[:, index, 0:3]

    def site_pos_w(self, index: Index) -> Tensor:
        """Return positions of sites in the world, m, [E, N, 3]."""
        return self._derived().site_xpos_EL[:, index]

    def site_lin_vel_w(self, index: Index) -> Tensor:
        """Return linear velocities of sites, world frame, m/s, [E, N, 3]."""
        body = self._site_body[index]
        return self._point_velocity(self._derived().site_xpos_EL[:, index], body, self._body_root[body])

    def _point_velocity(self, point_EN3: Tensor, body: Index, root: Tensor) -> Tensor:
        # MuJoCo's cvel is (angular, linear) about the centre of mass of the body's kinematic tree.
        cvel_EN6 = self.world.cvel_EL[:, body]
        lever_EN3 = point_EN3 - self.world.subtree_com_EL[:, root]
        return cvel_EN6[..., 3:] + torch.linalg.cross(cvel_EN6[..., :3], lever_EN3)

    # -- sensors, commands, actions, time ------------------------------------------------------------------------

    def sensor(self, name: str) -> Tensor:
        """Return the reading of an MJCF sensor, [E, dim]."""
        if name not in self._sensor_slices:
            raise ValueError(f"no sensor {name!r}: {near(name, self._sensor_slices)}")
        return self._derived().sensordata_EL[:, self._sensor_slices[name]]

    def contact(self, name: str) -> ContactState:
        """Return the state of a contact sensor of `cfg.scene.sensors`."""
        if name not in self.contacts:
            raise ValueError(f"no contact sensor {name!r} in scene.sensors: {near(name, self.contacts)}")
        return self.contacts[name].state

    def command(self, name: str) -> Tensor:
        """Return the command that the policy saw before this step, [E, K]."""
        if name not in self.commands:
            raise ValueError(f"no command {name!r} in commands: {near(name, self.commands)}")
        return self.commands[name]

    @quantity
    def episode_time_E(self) -> Tensor:
        """Time since the episode's start, s, [E]."""
        return self.episode_step_E.to(torch.float32) * self.step_dt

    # -- what terms keep and draw --------------------------------------------------------------------------------

    @contextmanager
    def scope(self, name: str, counter: Tensor | None = None, *, draws: str = "") -> Iterator[None]:
        """Run a term under a name, which separates its memory and its random draws from all others'.

        `counter` keys the draws (the step count unless given), and `draws` tells apart the moments of one term whose
        counters may coincide.
        """
        self._scope, self._draw_scope, self._draws = name, f"{name}@{draws}", 0
        self._counter = self.step_count if counter is None else counter
        try:
            yield
        finally:
            self._scope = ""

    def memory(self, name: str, *shape: int, dtype: torch.dtype = torch.float32, keep: bool = False) -> Tensor:
        """Return a buffer [E, *shape] that belongs to the calling term; rows that reset are zeroed unless `keep`."""
        return self.memories.get(f"{self._scope}.{name}", *shape, dtype=dtype, keep=keep)

    def uniform(self, n: int, low: float | Tensor = 0.0, high: float | Tensor = 1.0) -> Tensor:
        """Draw float32 [E, n] from [low, high); the numbers depend on seed, term, env and moment only."""
        return random.uniform(self._next_keys(), n, low, high)

    def normal(self, n: int) -> Tensor:
        """Draw float32 [E, n] from the standard normal distribution."""
        return random.normal(self._next_keys(), n)

    def _next_keys(self) -> random.RowKeys:
        stream = random.stream_id(f"{self._draw_scope}#{self._draws}")
        self._draws += 1
        return random.row_keys(self.seed, stream, self._counter, self.num_envs)

    # -- writes --------------------------------------------------------------------------------------------------

    def write_qpos(self, mask_E: Tensor, qpos_EL: Tensor) -> None:
        """Set all generalized positions, MuJoCo's layout, in the rows of `mask_E`."""
        self._write(self.world.qpos_EL, mask_E, qpos_EL)

    def write_qvel(self, mask_E: Tensor, qvel_EL: Tensor) -> None:
        """Set all generalized velocities, MuJoCo's layout, in the rows of `mask_E`."""
        self._write(self.world.qvel_EL, mask_E, qvel_EL)

    def write_root_pose(self, mask_E: Tensor, pos_EL: Tensor, quat_EL: Tensor) -> None:
        """Set position (m) and orientation (w, x, y, z) of the free root body in the rows of `mask_E`."""
        self._write(self.world.qpos_EL[:, 0:7], mask_E, torch.cat((pos_EL, quat_EL), dim=-1))

    def write_root_velocity(self, mask_E: Tensor, lin_vel_w_EL: Tensor, ang_vel_w_EL: Tensor) -> None:
        """Set the velocities (m/s, rad/s, world frame) of the free root body in the rows of `mask_E`."""
        ang_vel_b_EL = quaternion.rotate_inverse(self.world.qpos_EL[:, 3:7], ang_vel_w_EL)
        self._write(self.world.qvel_EL[:, 0:6], mask_E, torch.cat((lin_vel_w_EL, ang_vel_b_EL), dim=-1))

    def write_joint_pos(self, mask_E: Tensor, pos_EL: Tensor, joints: Index = slice(None)) -> None:
        """Set positions (rad or m) of the joints of `joints` in the rows of `mask_E`."""
        self._write_columns(self.world.qpos_EL, self._qpos_index, joints, mask_E, pos_EL)

    def write_joint_vel(self, mask_E: Tensor, vel_EL: Tensor, joints: Index = slice(None)) -> None:
        """Set velocities (rad/s or m/s) of the joints of `joints` in the rows of `mask_E`."""
        self._write_columns(self.world.qvel_EL, self._qvel_index, joints, mask_E, vel_EL)

    def write_ctrl(self, actuators: Index, ctrl_EK: Tensor) -> None:
        """Set the controls of `actuators` in all rows."""
        self.world.ctrl_EL[:, actuators] = ctrl_EK

    def field(self, name: str) -> Tensor:
        """Return a model field with one row per world, to be written in place (see `EventTerm.per_world_fields`)."""
        return self.world.field(name)

    def _write_columns(self, state_EL: Tensor, address: Index, joints: Index, mask_E: Tensor, value: Tensor) -> None:
        if isinstance(address, slice) and isinstance(joints, slice):
            self._write(state_EL[:, address][:, joints], mask_E, value)
            return
        if isinstance(address, slice):
            address = torch.arange(address.start, address.stop, device=self.device)
        columns = address[joints]
        state_EL[:, columns] = torch.where(mask_E[:, None], value, state_EL[:, columns])
        self.cache.clear()
        self._stale = True

    def _write(self, target_EL: Tensor, mask_E: Tensor, value_EL: Tensor) -> None:
        target_EL.copy_(torch.where(mask_E[:, None], value_EL, target_EL))
        self.cache.clear()
        self._stale = True

    # -- internals -----------------------------------------------------------------------------------------------

    def refreshed(self) -> None:
        """Forget computed quantities: the state has changed, and the world has refreshed what derives from it."""
        self.cache.clear()
        self._stale = False

    def detached(self, value: Tensor) -> Tensor:
        """Return `value`, copied if it shares memory with something that later steps overwrite."""
        return value.clone() if value.untyped_storage().data_ptr() in self._persistent else value

    def freeze(self) -> None:
        """End construction: no new memory, and all that lives on is known to `detached`."""
        self.memories.freeze()
        lasting = [*self.memories.buffers().values(), *self.world.views().values()]
        lasting += [self.episode_step_E, self.default_joint_pos_EL, self.default_qpos_L]
        self._persistent = {tensor.untyped_storage().data_ptr() for tensor in lasting}

    def _derived(self) -> World:
        """Return the world for reading what derives from the state, unless a write has made that stale."""
        if self._stale:
            raise RuntimeError(
                f"{self._scope or 'a term'} reads a derived quantity (pose of a body or site, sensor) after state was "
                "written in the same moment: read it before writing, or from the joint state"
            )
        return self.world

    @property
    def free_root(self) -> bool:
        """Whether the first joint is a free joint."""
        return self._free

    @property
    def _root_slice(self) -> slice:
        return slice(self._root_body, self._root_body + 1)

    def _soft_limits(self, joints: list[int], factor: float) -> Tensor:
        """Shrink the joint ranges about their middles; unlimited joints get infinite limits. [L, 2]."""
        model = self.world.mj_model
        limits = torch.tensor(model.jnt_range[joints], device=self.device, dtype=torch.float32).view(-1, 2)
        middle, half = limits.mean(-1), (limits[:, 1] - limits[:, 0]) / 2 * factor
        return self._limited(torch.stack((middle - half, middle + half), dim=-1), model.jnt_limited[joints])

    def _limited(self, limits_L2: Tensor, is_limited: np.ndarray) -> Tensor:
        """Make the limits of what has none infinite, [L, 2]."""
        mask_L1 = torch.tensor(is_limited, device=self.device, dtype=torch.bool).view(-1, 1)
        return torch.where(mask_L1, limits_L2, torch.tensor([-torch.inf, torch.inf], device=self.device))
