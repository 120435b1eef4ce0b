"""The view that parts of a scene and terms of an env read: named quantities of the current state."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.device import random
from ksim_rl.physics import World
from ksim_rl.scene.motions.motion import ReferenceMotion
from ksim_rl.scene.motions.motion_set import MotionSet, load_set, set_of
from ksim_rl.scene.names import NameResolver, Patterns, as_index, as_patterns, scalar_joint_ids
from ksim_rl.scene.near_names import NearNames
from ksim_rl.scene.state.buffers import ActuatorParams
from ksim_rl.scene.state.default_state import DefaultState
from ksim_rl.scene.state.elements import Bodies, Body, Joints, JointTables, Site, Sites
from ksim_rl.scene.state.entity import Entity
from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.state.joint_targets import JointTargets
from ksim_rl.scene.state.quantity import quantity, quantity_of
from ksim_rl.scene.state.simulation import Simulation

Points = TypeVar("Points", Bodies, Sites)


class WorldView(NearNames):
    """A typed view of the worlds: names, joints, bodies, sites, entities, clocks, buffers, keyed draws and writes.

    Position- and velocity-stage quantities (poses, velocities, most sensors) are of the current state.
    Acceleration-stage ones (contact sensors, accelerometers, actuator forces) belong to the last physics substep, and
    read zero in rows that were just reset. Each is computed at most once per state. All values are float32 on the env's
    device unless stated otherwise. Clocks are described in `Simulation`.

    Attributes:
        cache: a dict for a term's own quantities; it is emptied whenever the state changes.
        num_envs: how many worlds there are.
        device: where all tensors are.
        physics_dt: duration of a physics substep, s.
        step_dt: duration of an env step, s.
        max_episode_length: of episodes, in env steps; 0 for no limit.
        seed: seed of all draws, int64 [].
        step_count: how many env steps have begun, int64 [].
        reset_count_E: how often each env was reset, int64 [E].
        episode_step_E: env steps since the last reset, int64 [E].
        time_out_offset_E: env steps by which a staggered episode times out earlier, int64 [E].
        entities: robots and objects by name.
        robot: the first of them, whose quantities and writes the view has too.
        free_root: whether the first robot moves freely.
        num_joints: how many hinges and slides there are.
        default_qpos_L, default_qvel_L: the state at reset, in MuJoCo's layout.
        default_joint_pos_EL: positions of joints in the default pose, rad or m, which events may move.
        soft_joint_pos_limits_L2: ends of `scene.soft_joint_pos_limit_factor` of each joint's range, rad or m.
        encoder_bias_EL: the encoders' readings less the positions of joints, rad or m.
        joint_pos_target_EL: positions that joints are asked for, rad or m.
        joint_vel_target_EL: velocities that joints are asked for, rad/s or m/s.
        joint_effort_target_EL: efforts that joints are asked for, N m or N.
        ctrl_limits_L2: ends of the range of each actuator's control, infinite where there is none.
        actuator_params: numbers of explicit actuators: `actuator_param`.
        targets: turns the targets of joints into controls.
        write_root_pose, write_root_velocity: methods of `robot`.
        default_state: the state that resets restore.
        world: the worlds themselves: `derived`.
        resolver: finds elements of the model by names.
        buffers: tensors with a row per env that terms keep: `buffer`.
    """

    def __init__(
        self,
        simulation: Simulation,
        *,
        soft_joint_pos_limit_factor: float = 1.0,
        entities: Sequence[str] = (),
        motions: Mapping[str, MotionSet] | None = None,
    ) -> None:
        self._simulation = simulation
        self.world = simulation.world
        self.num_envs = simulation.num_envs
        self.device = simulation.device
        self.physics_dt = simulation.physics_dt
        self.step_dt = simulation.step_dt
        self.max_episode_length = simulation.max_episode_length
        # Shared with the simulation: these are its own tensors, not copies.
        self.buffers = simulation.buffers
        self.seed = simulation.seed
        self.step_count = simulation.step_count
        self.reset_count_E = simulation.reset_count_E
        self.episode_step_E = simulation.episode_step_E
        self.time_out_offset_E = simulation.time_out_offset_E
        self.resolver = NameResolver(self.world.mj_model, self.device)
        self.cache = simulation.new_cache()
        # Look-ups by patterns are remembered, since terms repeat them in each step.
        self._named: dict[tuple[str, tuple[str, ...]], Any] = {}
        self._motions: dict[str, ReferenceMotion] = {}
        self._motion_sets = motions or {}

        # MuJoCo keeps all sensors in one array; names give their slices.
        model = self.world.mj_model
        joints = scalar_joint_ids(self.world.mj_model)
        self.num_joints = len(joints)
        places = zip(model.sensor_adr.tolist(), model.sensor_dim.tolist(), strict=True)
        slices = (slice(first, first + size) for first, size in places)
        self._sensor_slices = dict(zip(self.resolver.names("sensor"), slices, strict=True))

        # The state that resets restore comes before the targets, which start from it.
        self.default_state = DefaultState(simulation)
        self.default_qpos_L = torch.tensor(
            self.default_state.qpos_L, device=self.device, dtype=torch.float32
        )
        self.default_qvel_L = torch.tensor(
            self.default_state.qvel_L, device=self.device, dtype=torch.float32
        )
        default_joint_pos_L = self.default_qpos_L[
            as_index(model.jnt_qposadr[joints].tolist(), self.device)
        ]
        # A buffer with a row per env: events may move the default pose, and resets keep it.
        self.default_joint_pos_EL = self.buffers.get(
            "default_joint_pos_EL", self.num_joints, keep=True, initial=default_joint_pos_L
        )
        # Zero unless an event draws it.
        self.encoder_bias_EL = self.buffers.get("encoder_bias_EL", self.num_joints, keep=True)
        self.targets = JointTargets(
            self.world,
            self.resolver,
            self.buffers,
            default_joint_pos_EL=self.default_joint_pos_EL,
            encoder_bias_EL=self.encoder_bias_EL,
            default_state=self.default_state,
        )
        self.joint_pos_target_EL = self.targets.pos_EL
        self.joint_vel_target_EL = self.targets.vel_EL
        self.joint_effort_target_EL = self.targets.effort_EL
        self.actuator_params = ActuatorParams(
            self.buffers, self.resolver.names("joint"), self.device
        )
        ctrl_range = torch.tensor(model.actuator_ctrlrange, device=self.device, dtype=torch.float32)
        # Infinite where the model has no limit.
        self.ctrl_limits_L2 = self._limited(ctrl_range.view(-1, 2), model.actuator_ctrllimited)
        self.soft_joint_pos_limits_L2 = self._soft_limits(joints, soft_joint_pos_limit_factor)
        # One object for all joints; parts share its tables.
        tables = JointTables(
            self.default_joint_pos_EL, self.soft_joint_pos_limits_L2, self.encoder_bias_EL
        )
        self._every_joint = Joints(
            simulation, range(self.num_joints), self.resolver.names("joint"), tables
        )
        self.entities = {
            name: Entity(
                simulation,
                name=name,
                # A single entity keeps its plain names.
                prefix=f"{name}/" if len(entities) > 1 else "",
                default_qpos_L=self.default_qpos_L,
                every_joint=self._every_joint,
            )
            for name in entities or ("robot",)
        }
        # The first entity is the robot that terms mean without a name.
        self.robot = next(iter(self.entities.values()))
        self.free_root = self.robot.free_root
        self.write_root_pose = self.robot.write_root_pose
        self.write_root_velocity = self.robot.write_root_velocity

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
        """Return the one body of this name (or pattern): `view.body("torso").lin_vel_EL`."""
        self.resolver.one("body", name)
        return Body(self.bodies(name))

    def sites(self, patterns: Patterns) -> Sites:
        """Return the matching sites: `view.sites(".*_foot").height_EN`."""
        return self._points(Sites, "site", patterns)

    def site(self, name: str) -> Site:
        """Return the one site of this name (or pattern): `view.site("finger").pos_EL`."""
        self.resolver.one("site", name)
        return Site(self.sites(name))

    def _points(self, kind: type[Points], element: str, patterns: Patterns) -> Points:
        # Bodies and sites of the same patterns are different entries.
        key = (element, as_patterns(patterns))
        if key not in self._named:
            ids = self.resolver.ids(element, patterns)
            names = self.resolver.names(element)
            self._named[key] = kind(self._simulation, ids, [names[i] for i in ids])
        return self._named[key]

    # -- joints, and the first robot ------------------------------------------------------------------------------

    joint_pos_EL = quantity_of("_every_joint", Joints.pos_EL)
    joint_vel_EL = quantity_of("_every_joint", Joints.vel_EL)
    joint_acc_EL = quantity_of("_every_joint", Joints.acc_EL)
    joint_effort_EL = quantity_of("_every_joint", Joints.effort_EL)
    joint_pos_rel_EL = quantity_of("_every_joint", Joints.pos_rel_EL)
    root_pos_EL = quantity_of("robot", Entity.root_pos_EL)
    root_quat_EL = quantity_of("robot", Entity.root_quat_EL)
    root_lin_vel_w_EL = quantity_of("robot", Entity.root_lin_vel_w_EL)
    root_ang_vel_w_EL = quantity_of("robot", Entity.root_ang_vel_w_EL)
    root_lin_vel_b_EL = quantity_of("robot", Entity.root_lin_vel_b_EL)
    root_ang_vel_b_EL = quantity_of("robot", Entity.root_ang_vel_b_EL)
    projected_gravity_EL = quantity_of("robot", Entity.projected_gravity_EL)
    heading_E = quantity_of("robot", Entity.heading_E)

    @property
    def terrain(self) -> Ground:
        """The ground under each env."""
        return self._simulation.ground

    # -- entities -------------------------------------------------------------------------------------------------

    def entity(self, name: str = "") -> Entity:
        """Return a robot or object of the scene by name; "" is the first robot."""
        if not name:
            return self.robot
        if name not in self.entities:
            raise ValueError(
                f"no entity {name!r} in scene.robots and scene.objects: {near(name, self.entities)}"
            )
        return self.entities[name]

    def at_origins(self, qpos_EL: Float[Tensor, "E L"]) -> Float[Tensor, "E L"]:
        """Return generalized positions in which all free roots have moved with the origins of their envs."""
        # A copy: the given positions may be the model's own.
        qpos_EL = qpos_EL.clone()
        for entity in self.entities.values():
            # Fixed roots are part of the model, and stay where they are.
            if entity.free_root:
                start = entity.root_qpos.start
                qpos_EL[:, start : start + 3] += self.terrain.origins_E3
        return qpos_EL

    # -- sensors, motions, time -------------------------------------------------------------------------------------

    def sensor(self, name: str) -> Float[Tensor, "E L"]:
        """Return the reading of an MJCF sensor."""
        if name not in self._sensor_slices:
            raise ValueError(f"no sensor {name!r}: {near(name, self._sensor_slices)}")
        # Kept as other quantities are, so that whoever asks what a term has read finds it by its name.
        key = f"sensor/{name}"
        if key not in self.cache:
            self.cache[key] = self._simulation.derived().sensordata_EL[:, self._sensor_slices[name]]
        return self.cache[key]

    def parts(self) -> dict[str, object]:
        """Return the objects that hold the quantities and tables of the view, by how a term spells them."""
        # For messages about a term that writes where it only may read.
        parts: dict[str, object] = {
            "view": self,
            "view.joints()": self._every_joint,
            "view.terrain": self.terrain,
        }
        for name, entity in self.entities.items():
            parts[f"view.entity({name!r})"] = entity
        for (kind, patterns), elements in self._named.items():
            plural = "bodies" if kind == "body" else f"{kind}s"
            parts[f"view.{plural}({list(patterns)})"] = elements
        for file, motion in self._motions.items():
            parts[f"view.motion({file!r})"] = motion
        return parts

    def derived(self) -> World:
        """Return the world for reading derived quantities: `Simulation.derived`."""
        return self._simulation.derived()

    def motion(self, file: str) -> ReferenceMotion:
        """Return the reference motion of an .npz file, a folder, or the name of a set of motions in the scene's config.

        It is read once, while the env is constructed.
        """
        # Reading a file belongs to construction: a captured step could not do it.
        if file not in self._motions:
            chosen = set_of(self._motion_sets, file)
            self._motions[file] = load_set(chosen, self.world.mj_model, self.device)
        return self._motions[file]

    def check_motions(self) -> None:
        """Refuse, by a ValueError, sets of motions that nothing has read while the env was constructed."""
        for name in self._motion_sets:
            if name not in self._motions:
                raise ValueError(
                    f"scene.motions.{name}: no term reads this set of motions: name it as the `file` of the terms that "
                    "follow it, or leave it out"
                )

    @quantity
    def episode_time_E(self) -> Float[Tensor, " E"]:
        """Time since the episode's start, s."""
        return self.episode_step_E.to(torch.float32) * self.step_dt

    # -- actuators -----------------------------------------------------------------------------------------------

    def actuator_param(self, name: str, joints: Patterns | None = None) -> Float[Tensor, "E L"]:
        """Return a number of explicit actuators, such as "stiffness", that all `joints` have, to read or write.

        A value that an event writes holds from the next substep until it is written again: resets leave it alone.
        Built-in actuators have model fields instead (`actuators.builtin`).
        """
        return self.actuator_params.get(
            name, () if joints is None else self.resolver.ids("joint", joints)
        )

    # -- what terms keep and draw --------------------------------------------------------------------------------

    def buffer(
        self, name: str, *shape: int, dtype: torch.dtype = torch.float32, keep: bool = False
    ) -> Shaped[Tensor, " E *shape"]:
        """Return a buffer that belongs to the calling term; rows that reset are zeroed unless `keep`.

        A value that a term writes in each call advances once per env step.
        """
        # Prefixed by the running term, so that two terms may use the same name.
        full_name = self._simulation.scoped(name)
        owner = self._simulation.reader
        return self.buffers.get(full_name, *shape, dtype=dtype, keep=keep, owner=owner)

    def shared(
        self,
        name: str,
        initial: float | Sequence[float] | Sequence[Sequence[float]],
        *,
        of_curriculum: bool = False,
    ) -> Float[Tensor, "*shape"]:
        """Return a float32 tensor of the calling term that all envs share; it starts at `initial` and is saved.

        With `of_curriculum` all terms read the same one by this name, and a curriculum writes it.
        """
        if of_curriculum:
            return self._simulation.shared_values.get(name, initial)
        full_name = self._simulation.scoped(name)
        owner = self._simulation.reader
        return self._simulation.shared_values.get(full_name, initial, owner=owner)

    def uniform(
        self,
        n: int,
        low: float | Float[Tensor, "*low"] = 0.0,
        high: float | Float[Tensor, "*high"] = 1.0,
    ) -> Float[Tensor, "E L"]:
        """Draw float32 from [low, high); the numbers depend on seed, term, env and moment only."""
        return random.uniform(self.next_keys(), n, low, high)

    def normal(self, n: int) -> Float[Tensor, "E L"]:
        """Draw float32 from the standard normal distribution."""
        return random.normal(self.next_keys(), n)

    def integers(self, n: int, low: int, high: int) -> Int64[Tensor, "E L"]:
        """Draw from {low, ..., high}, both included."""
        return random.integers(self.next_keys(), n, low, high)

    def next_keys(self) -> random.RowKeys:
        """Return the coordinates of the next draw of the calling term, for a kernel that draws its numbers itself."""
        return self._simulation.next_keys()

    # -- writes --------------------------------------------------------------------------------------------------

    def restore_default(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Put the rows of `mask_E` into the default state, on a terrain at their envs' origins; not their controls."""
        self.default_state.restore(mask_E)
        # On flat ground all origins are zero.
        if not self.terrain.is_flat:
            # All free roots move, of objects as well.
            self.write_qpos(mask_E, self.at_origins(self.default_qpos_L.expand(self.num_envs, -1)))

    def write_qpos(self, mask_E: Bool[Tensor, " E"], qpos_EL: Float[Tensor, "E L"]) -> None:
        """Set all generalized positions, MuJoCo's layout, in the rows of `mask_E`."""
        self._simulation.write(self.world.qpos_EL, slice(None), mask_E, qpos_EL)

    def write_qvel(self, mask_E: Bool[Tensor, " E"], qvel_EL: Float[Tensor, "E L"]) -> None:
        """Set all generalized velocities, MuJoCo's layout, in the rows of `mask_E`."""
        self._simulation.write(self.world.qvel_EL, slice(None), mask_E, qvel_EL)

    def write_joint_pos_target(self, joints: Patterns, target_EK: Float[Tensor, "E K"]) -> None:
        """Ask joints for readings of their encoders, rad or m, in all rows: `JointTargets.write`.

        Without a bias of encoders (`encoder_bias_EL`) these are positions.
        """
        self.targets.write("pos", joints, target_EK)

    def write_joint_vel_target(self, joints: Patterns, target_EK: Float[Tensor, "E K"]) -> None:
        """Ask joints for velocities, rad/s or m/s, in all rows: `JointTargets.write`."""
        self.targets.write("vel", joints, target_EK)

    def write_joint_effort_target(self, joints: Patterns, target_EK: Float[Tensor, "E K"]) -> None:
        """Ask joints for efforts, N m or N, in all rows; efforts of the MJCF's motors are clamped, then geared."""
        self.targets.write("effort", joints, target_EK)

    def field(self, name: str) -> Shaped[Tensor, " E *shape"]:
        """Return a model field with one row per world, to be written in place (see `EventTerm.per_world_fields`)."""
        return self.world.field(name)

    def _soft_limits(self, joints: list[int], factor: float) -> Tensor:
        """Shrink the joint ranges about their middles; unlimited joints get infinite limits. [L, 2]."""
        model = self.world.mj_model
        limits = torch.tensor(
            model.jnt_range[joints], device=self.device, dtype=torch.float32
        ).view(-1, 2)
        # Shrunk about the middle, so that both ends give way alike.
        middle = limits.mean(-1)
        half = (limits[:, 1] - limits[:, 0]) / 2 * factor
        return self._limited(
            torch.stack((middle - half, middle + half), dim=-1), model.jnt_limited[joints]
        )

    def _limited(self, limits_L2: Float[Tensor, "L 2"], is_limited: np.ndarray) -> Tensor:
        """Make the limits of elements without any infinite, [L, 2]."""
        # [L, 1], to choose both ends together.
        mask_L1 = torch.tensor(is_limited, device=self.device, dtype=torch.bool).view(-1, 1)
        return torch.where(
            mask_L1, limits_L2, torch.tensor([-torch.inf, torch.inf], device=self.device)
        )
