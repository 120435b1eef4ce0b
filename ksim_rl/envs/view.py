"""What terms read: named quantities of the current state, each computed at most once per step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.device import random
from ksim_rl.physics import World
from ksim_rl.scene.actuators import ActuatorParams, JointTargets
from ksim_rl.scene.motions.motion import ReferenceMotion, load_motion
from ksim_rl.scene.names import (
    Index,
    NameResolver,
    Patterns,
    as_index,
    as_patterns,
    scalar_joint_ids,
)
from ksim_rl.scene.sensors import (
    CameraTracker,
    ContactState,
    ContactTracker,
    ImuTracker,
    RayTracker,
    SensorTracker,
)
from ksim_rl.scene.state.bodies_and_sites import Bodies, Body, Site, Sites
from ksim_rl.scene.state.buffers import Buffers, SharedValues
from ksim_rl.scene.state.entity import Entity
from ksim_rl.scene.state.first_robot import FirstRobot
from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.state.guarded_state import GuardedState
from ksim_rl.scene.state.joints import Joints, JointTables
from ksim_rl.scene.state.quantity import quantity

Tracker = TypeVar("Tracker", bound=SensorTracker)
Points = TypeVar("Points", Bodies, Sites)


class EnvView(FirstRobot):
    """A typed view of the world for terms.

    Position- and velocity-stage quantities (poses, velocities, most sensors) are those of the current state.
    Acceleration-stage ones (contact sensors, accelerometers, actuator forces) belong to the last physics substep, and
    read zero in rows that were just reset. All values are float32 on the env's device unless stated otherwise.

    Attributes:
        level: the difficulty in [0, 1] that a curriculum drives, [] on the device; 1 where none does. It is one tensor
            for the life of the env, changed in place, so that what scales with difficulty may hold on to it.
        reward_weights: by term, [] each; a curriculum may write them.
        episode_rewards: by term, the weighted sum over the episode so far, [E] each.
        command_ranges: by command and field, (low, high) [2] each; a curriculum may write them.
        terminations: by term, and "non_finite": which envs end, bool [E], as the step found it.
        terminated_E, truncated_E: which envs the step found to end by a condition that is no time-out, and by a
            time-out, bool [E]; `is_finite_horizon` does not matter here.
        command_cache: what is computed from commands alone; emptied when they change.
    """

    def __init__(
        self,
        world: World,
        *,
        step_dt: float,
        max_episode_length: int = 0,
        soft_joint_pos_limit_factor: float = 1.0,
        entities: Sequence[str] = (),
    ) -> None:
        model = world.mj_model
        self.max_episode_length = max_episode_length
        self.world = world
        self.num_envs, self.device = world.num_envs, world.device
        self.physics_dt, self.step_dt = float(model.opt.timestep), step_dt
        self.resolver = NameResolver(model, world.device)
        self._state = GuardedState(world)
        self.cache = self._state.new_cache()
        self.command_cache = self._state.new_cache()
        self.buffers = Buffers(world.num_envs, world.device)
        self.shared_values = SharedValues(world.device)
        self.level = self.shared_values.get("curriculum.level", 1.0)
        self.sensors: dict[str, SensorTracker] = {}
        self.commands: dict[str, Tensor] = {}
        self.reward_weights: dict[str, Tensor] = {}
        self.episode_rewards: dict[str, Tensor] = {}
        self.command_ranges: dict[str, dict[str, Tensor]] = {}
        self.terminations: dict[str, Tensor] = {}
        self._named: dict[tuple[str, tuple[str, ...]], Any] = {}
        self._motions: dict[str, ReferenceMotion] = {}
        self.terminated_E = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.truncated_E = torch.zeros_like(self.terminated_E)
        # Called around each physics substep (see `World.step`); they read the world, whose state is on its way.
        self.before_substep: list[Callable[[], None]] = []
        self.after_substep: list[Callable[[], None]] = []
        self.substep_sensors: Literal["last", "every"] = "last"

        joints = scalar_joint_ids(model)
        self.num_joints = len(joints)
        self._sensor_slices = {
            model.sensor(i).name: slice(
                int(model.sensor_adr[i]), int(model.sensor_adr[i] + model.sensor_dim[i])
            )
            for i in range(model.nsensor)
        }

        default_qpos = torch.tensor(
            model.key_qpos[0] if model.nkey else model.qpos0, device=self.device, dtype=torch.float32
        )
        self.default_qpos_L = default_qpos
        default_joint_pos_L = default_qpos[as_index([model.jnt_qposadr[j] for j in joints], self.device)]
        self.default_joint_pos_EL = self.buffers.get(
            "default_joint_pos_EL", self.num_joints, keep=True, initial=default_joint_pos_L
        )
        self.targets = JointTargets(
            world, self.resolver, self.buffers, default_joint_pos_EL=self.default_joint_pos_EL
        )
        self.actuator_params = ActuatorParams(self.buffers, self.resolver.names("joint"), self.device)
        ctrl_range = torch.tensor(model.actuator_ctrlrange, device=self.device, dtype=torch.float32)
        self.ctrl_limits_L2 = self._limited(ctrl_range.view(-1, 2), model.actuator_ctrllimited)
        self.soft_joint_pos_limits_L2 = self._soft_limits(joints, soft_joint_pos_limit_factor)
        self.time_out_offset_E = self.buffers.get("time_out_offset_E", dtype=torch.int64)
        self.encoder_bias_EL = self.buffers.get("encoder_bias_EL", self.num_joints, keep=True)
        self._joint_tables = JointTables(
            self.default_joint_pos_EL, self.soft_joint_pos_limits_L2, self.encoder_bias_EL
        )
        self._every_joint = Joints(
            self._state, range(self.num_joints), self.resolver.names("joint"), self._joint_tables
        )
        several = len(entities) > 1
        self.entities = {
            name: Entity(
                self._state,
                name=name,
                prefix=f"{name}/" if several else "",
                default_qpos_L=default_qpos,
                every_joint=self._every_joint,
            )
            for name in entities or ("robot",)
        }
        self.robot = next(iter(self.entities.values()))

        zero = torch.zeros((), dtype=torch.int64, device=self.device)
        self.seed = zero.clone()
        self.step_count = zero.clone()
        self.reset_count_E = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self.episode_step_E = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self.action_EL = torch.zeros(self.num_envs, 0, device=self.device)
        self.last_action_EL = torch.zeros(self.num_envs, 0, device=self.device)
        self.startup_counter = zero
        self._counter: Tensor = zero
        self._persistent: set[int] = set()
        self._scope, self._draw_scope, self._draws = "", "", 0

    # -- names ---------------------------------------------------------------------------------------------------

    def joints(self, patterns: Patterns | None = None) -> Joints:
        """Return the matching hinges and slides, all of them without `patterns`: `view.joints("hip.*").pos_EL`."""
        if patterns is None:
            return self._every_joint
        key = ("joint", as_patterns(patterns))
        if key not in self._named:
            self._named[key] = self._every_joint.some(self.resolver.ids("joint", patterns))
        return self._named[key]

    def bodies(self, patterns: Patterns) -> Bodies:
        """Return the matching bodies: `view.bodies(".*_foot").pos_EN3`."""
        return self._points(Bodies, "body", patterns)

    def body(self, name: str) -> Body:
        """Return the one body of this name (or pattern): `view.body("torso").lin_vel_EL`.

        Raises:
            ValueError: if several match.
        """
        self.resolver.one("body", name)
        return Body(self.bodies(name))

    def sites(self, patterns: Patterns) -> Sites:
        """Return the matching sites: `view.sites(".*_foot").height_EN`."""
        return self._points(Sites, "site", patterns)

    def site(self, name: str) -> Site:
        """Return the one site of this name (or pattern): `view.site("finger").pos_EL`.

        Raises:
            ValueError: if several match.
        """
        self.resolver.one("site", name)
        return Site(self.sites(name))

    def _points(self, kind: type[Points], element: str, patterns: Patterns) -> Points:
        key = (element, as_patterns(patterns))
        if key not in self._named:
            ids, names = self.resolver.ids(element, patterns), self.resolver.names(element)
            self._named[key] = kind(self._state, ids, [names[i] for i in ids])
        return self._named[key]

    # -- joints --------------------------------------------------------------------------------------------------

    @property
    def joint_pos_EL(self) -> Float[Tensor, "E L"]:
        """Positions of all hinges (rad) and slides (m), in the model's order, [E, L]."""
        return self._every_joint.pos_EL

    @property
    def joint_vel_EL(self) -> Float[Tensor, "E L"]:
        """Velocities of all hinges (rad/s) and slides (m/s), in the model's order, [E, L]."""
        return self._every_joint.vel_EL

    @property
    def joint_acc_EL(self) -> Float[Tensor, "E L"]:
        """Accelerations of all hinges (rad/s^2) and slides (m/s^2); acceleration stage, [E, L]."""
        return self._every_joint.acc_EL

    @property
    def joint_effort_EL(self) -> Float[Tensor, "E L"]:
        """What actuators exert on all hinges (N m) and slides (N), behind the gears; acceleration stage, [E, L]."""
        return self._every_joint.effort_EL

    @property
    def joint_pos_rel_EL(self) -> Float[Tensor, "E L"]:
        """Joint positions minus the default pose, [E, L]."""
        return self._every_joint.pos_rel_EL

    @property
    def terrain(self) -> Ground:
        """The ground under each env."""
        return self._state.ground

    @terrain.setter
    def terrain(self, ground: Ground) -> None:
        self._state.ground = ground

    # -- entities -------------------------------------------------------------------------------------------------

    def entity(self, name: str = "") -> Entity:
        """Return a robot or object of the scene by name; "" is the first robot.

        Raises:
            ValueError: if there is none of this name, with the near names.
        """
        if not name:
            return self.robot
        if name not in self.entities:
            raise ValueError(
                f"no entity {name!r} in scene.robots and scene.objects: {near(name, self.entities)}"
            )
        return self.entities[name]

    # -- sensors, commands, actions, time ------------------------------------------------------------------------

    def sensor(self, name: str) -> Tensor:
        """Return the reading of an MJCF sensor, [E, dim]."""
        if name not in self._sensor_slices:
            raise ValueError(f"no sensor {name!r}: {near(name, self._sensor_slices)}")
        return self._state.derived().sensordata_EL[:, self._sensor_slices[name]]

    def contact(self, name: str) -> ContactState:
        """Return the state of a contact sensor of `cfg.scene.sensors`."""
        return self.tracker(name, ContactTracker, "contact sensor").state

    def imu(self, name: str) -> ImuTracker:
        """Return an `ImuSensor` of `cfg.scene.sensors`, which has its readings."""
        return self.tracker(name, ImuTracker, "IMU")

    def rays(self, name: str) -> RayTracker:
        """Return a `RayCaster` of `cfg.scene.sensors`; its rays are cast when they are read."""
        return self.tracker(name, RayTracker, "ray caster")

    def camera(self, name: str) -> CameraTracker:
        """Return a `CameraSensor` of `cfg.scene.sensors`; its pictures are drawn when they are read."""
        return self.tracker(name, CameraTracker, "camera")

    def derived(self) -> World:
        """Return the world for reading what derives from the state.

        Raises:
            RuntimeError: if state was written in the same moment, which has made that stale.
        """
        return self._state.derived()

    def tracker(self, name: str, kind: type[Tracker], described: str) -> Tracker:
        """Return the reader of a sensor of `cfg.scene.sensors`.

        Raises:
            ValueError: if there is no such sensor of this kind.
        """
        tracker = self.sensors.get(name)
        if not isinstance(tracker, kind):
            names = [other for other, present in self.sensors.items() if isinstance(present, kind)]
            raise ValueError(f"no {described} {name!r} in scene.sensors: {near(name, names)}")
        return tracker

    def command(self, name: str) -> Tensor:
        """Return the command that the policy saw before this step, [E, K]."""
        if name not in self.commands:
            raise ValueError(f"no command {name!r} in commands: {near(name, self.commands)}")
        return self.commands[name]

    def motion(self, file: str) -> ReferenceMotion:
        """Return the reference motion of an .npz file; it is read once, while the env is constructed."""
        if file not in self._motions:
            self._motions[file] = load_motion(file, self.world.mj_model, self.device)
        return self._motions[file]

    @quantity
    def episode_time_E(self) -> Tensor:
        """Time since the episode's start, s, [E]."""
        return self.episode_step_E.to(torch.float32) * self.step_dt

    # -- actuators -----------------------------------------------------------------------------------------------

    @property
    def joint_pos_target_EL(self) -> Tensor:
        """Positions that joints are asked for, rad or m, [E, L]; the default pose until an action asks otherwise."""
        return self.targets.pos_EL

    @property
    def joint_vel_target_EL(self) -> Tensor:
        """Velocities that joints are asked for, rad/s or m/s, [E, L]."""
        return self.targets.vel_EL

    @property
    def joint_effort_target_EL(self) -> Tensor:
        """Efforts that joints are asked for, N m or N, [E, L]."""
        return self.targets.effort_EL

    def actuator_param(self, name: str, joints: Patterns | None = None) -> Tensor:
        """Return a number of explicit actuators, [E, L], such as "stiffness", to be read or written in place.

        `joints` names those that must have it. What an event writes holds from the next substep on, and until it is
        written again: resets leave it alone. Built-in actuators have model fields instead (`actuators.builtin`).

        Raises:
            ValueError: if there is no such number, or one of `joints` does not have it.
        """
        return self.actuator_params.get(name, () if joints is None else self.resolver.ids("joint", joints))

    def nominal_actuator_param(self, name: str) -> Tensor:
        """Return the numbers of `actuator_param` as the config gives them, [L]."""
        return self.actuator_params.nominal(name)

    # -- what terms keep and draw --------------------------------------------------------------------------------

    @contextmanager
    def scope(self, name: str, counter: Tensor | None = None, *, draws: str = "") -> Iterator[None]:
        """Run a term under a name, which separates its buffers and its random draws from all others'.

        `counter` keys the draws (the step count unless given), and `draws` tells apart the moments of one term whose
        counters may coincide.

        Raises:
            ValueError: what the term raises, with its name before it.
        """
        self._scope, self._draw_scope, self._draws = name, f"{name}@{draws}", 0
        self._state.reader = name
        self._counter = self.step_count if counter is None else counter
        try:
            yield
        except ValueError as error:
            # A term does not know its own place in the config.
            raise ValueError(f"{name.replace('/', '.')}: {error}") from error
        finally:
            self._scope = self._state.reader = ""

    def buffer(
        self, name: str, *shape: int, dtype: torch.dtype = torch.float32, keep: bool = False
    ) -> Tensor:
        """Return a buffer [E, *shape] that belongs to the calling term; rows that reset are zeroed unless `keep`."""
        return self.buffers.get(f"{self._scope}.{name}", *shape, dtype=dtype, keep=keep)

    def shared(self, name: str, initial: float | Sequence[float] | Sequence[Sequence[float]]) -> Tensor:
        """Return a float32 tensor of the calling term that all envs share; it starts at `initial` and is saved."""
        return self.shared_values.get(f"{self._scope}.{name}", initial)

    def uniform(self, n: int, low: float | Tensor = 0.0, high: float | Tensor = 1.0) -> Tensor:
        """Draw float32 [E, n] from [low, high); the numbers depend on seed, term, env and moment only."""
        return random.uniform(self._next_keys(), n, low, high)

    def normal(self, n: int) -> Tensor:
        """Draw float32 [E, n] from the standard normal distribution."""
        return random.normal(self._next_keys(), n)

    def integers(self, n: int, low: int, high: int) -> Tensor:
        """Draw int64 [E, n] from {low, ..., high}, both included."""
        return random.integers(self._next_keys(), n, low, high)

    def _next_keys(self) -> random.RowKeys:
        stream = random.stream_id(f"{self._draw_scope}#{self._draws}")
        self._draws += 1
        return random.row_keys(self.seed, stream, self._counter, self.num_envs)

    # -- writes --------------------------------------------------------------------------------------------------

    def write_qpos(self, mask_E: Tensor, qpos_EL: Tensor) -> None:
        """Set all generalized positions, MuJoCo's layout, in the rows of `mask_E`."""
        self._state.write(self.world.qpos_EL, mask_E, qpos_EL)

    def write_qvel(self, mask_E: Tensor, qvel_EL: Tensor) -> None:
        """Set all generalized velocities, MuJoCo's layout, in the rows of `mask_E`."""
        self._state.write(self.world.qvel_EL, mask_E, qvel_EL)

    def write_joint_pos_target(self, joints: Patterns, target_EK: Tensor) -> None:
        """Ask joints for positions, rad or m, in all rows; one column per joint, in the order of `joints`.

        Raises:
            ValueError: if a joint has no actuator that takes positions.
        """
        self.targets.write("pos", joints, target_EK)

    def write_joint_vel_target(self, joints: Patterns, target_EK: Tensor) -> None:
        """Ask joints for velocities, rad/s or m/s, in all rows; one column per joint, in the order of `joints`.

        Raises:
            ValueError: if a joint has no actuator that takes velocities.
        """
        self.targets.write("vel", joints, target_EK)

    def write_joint_effort_target(self, joints: Patterns, target_EK: Tensor) -> None:
        """Ask joints for efforts, N m or N, in all rows; one column per joint, in the order of `joints`.

        The control ranges of motors clamp them. A motor of the MJCF multiplies them by its gear and gain.

        Raises:
            ValueError: if a joint has no actuator that takes efforts.
        """
        self.targets.write("effort", joints, target_EK)

    def write_ctrl(self, actuators: Index, ctrl_EK: Tensor) -> None:
        """Set the controls of `actuators` in all rows."""
        self.world.ctrl_EL[:, actuators] = ctrl_EK

    def field(self, name: str) -> Tensor:
        """Return a model field with one row per world, to be written in place (see `EventTerm.per_world_fields`)."""
        return self.world.field(name)

    # -- internals -----------------------------------------------------------------------------------------------

    def forget(self) -> None:
        """Forget computed quantities; what may be read does not change."""
        self._state.forget()

    def refreshed(self) -> None:
        """Forget computed quantities: the state has changed, and the world has refreshed what derives from it."""
        self._state.refreshed()

    def changed(self) -> None:
        """Forget computed quantities: rows were reset, and what derives from the state has not followed yet."""
        self._state.changed()

    def detached(self, value: Tensor) -> Tensor:
        """Return `value`, copied if it shares memory with something that later steps overwrite."""
        return value.clone() if value.untyped_storage().data_ptr() in self._persistent else value

    def freeze(self) -> None:
        """End construction: no new buffers, and all that lives on is known to `detached`."""
        self._state.is_frozen = True
        self.buffers.freeze()
        self.shared_values.freeze()
        lasting = [*self.buffers.by_name().values(), *self.world.views().values()]
        lasting += [*self.shared_values.by_name().values(), *self.world.per_world_fields().values()]
        lasting += [self.episode_step_E, self.default_joint_pos_EL, self.default_qpos_L]
        self._persistent = {tensor.untyped_storage().data_ptr() for tensor in lasting}

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
