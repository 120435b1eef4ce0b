"""Puts the scene of one world together: robots at their places on a terrain, and sensors."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Protocol, runtime_checkable

import mujoco

from ksim_rl.checked import Checked, Count, Filled, NonNegative, Share
from ksim_rl.checks import near
from ksim_rl.physics import SimCfg, load_model, load_spec, prepare_spec
from ksim_rl.scene.actuators import Actuator, set_actuators
from ksim_rl.scene.joining import joined
from ksim_rl.scene.keyframes import complete_keyframes, move_keyframe
from ksim_rl.scene.motions.motion_set import MotionSet
from ksim_rl.scene.sensors import Sensor
from ksim_rl.scene.terrains import Terrain

# What a world of one moving body takes at least: state, kinematics, inertias and forces.
NUMBERS_PER_WORLD = 250


@dataclass(frozen=True, kw_only=True)
class Placement(Checked):
    """A rigid transform from an entity's own world frame into the scene's: m, and a unit quaternion (w, x, y, z)."""

    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def _check_fields(self) -> None:
        super()._check_fields()
        if not math.isclose(math.hypot(*self.quat), 1.0, abs_tol=1e-3):
            raise ValueError(f"quat={self.quat!r}: expected a unit quaternion (w, x, y, z)")

    def move(self, spec: mujoco.MjSpec) -> None:
        """Move all that stands in the spec's world, and its poses in the keyframes."""
        # Compiled first: `move_keyframe` finds free joints in the model.
        model = load_model(spec)
        world = spec.worldbody
        # Elements inside of a frame move with that frame.
        loose = [
            element
            for kind in (
                world.frames,
                world.bodies,
                world.geoms,
                world.sites,
                world.cameras,
                world.lights,
            )
            for element in kind
            if element.frame is None
        ]
        # One frame for all: children keep their own poses.
        frame = world.add_frame(pos=self.pos, quat=self.quat)
        for element in loose:
            element.set_frame(frame)
        for key in spec.keys:
            move_keyframe(key, model, self.pos, self.quat)


@runtime_checkable
class Robot(Protocol):
    """A robot as a scene needs it: its model, as a spec that can still be edited.

    A robot whose joints are driven by entries of `ksim_rl.scene.actuators` has them in an attribute `actuators`, and
    its `spec` puts them into the model by `set_actuators`.
    """

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the robot; its first keyframe, if any, is the default state, which resets restore."""
        ...


@dataclass(frozen=True, kw_only=True)
class MjcfRobot(Checked):
    """A robot or a whole scene from a source for `physics.load_spec`: an MJCF file, an XML string or a menagerie name.

    `actuators` drive joints in place of the model's own actuators of these joints.
    """

    source: str
    actuators: tuple[Actuator, ...] = ()

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = load_spec(self.source)
        set_actuators(spec, self.actuators)
        return spec


@dataclass(frozen=True, kw_only=True)
class SceneCfg(Checked):
    """The entities of each world, by name; gravity and the other options are the first robot's.

    The elements of an entity (robot or object: a cube, a ball, a door) that is alone keep their names; of several they
    get the prefix "<name>/". Entities without a placement stand where their own models put them. Sensors are for
    `view.contact(name)` and its kin; sensors of the MJCF need no entry here.
    """

    robots: Annotated[
        Mapping[str, Robot], Filled("name at least one robot")
    ]  # the first is what terms mean
    objects: Mapping[str, Robot] = field(default_factory=dict)  # cubes, balls, doors
    placements: Mapping[str, Placement] = field(default_factory=dict)  # by entity
    terrain: Terrain | None = None  # None: the robot's own model has its ground
    sensors: Mapping[str, Sensor] = field(default_factory=dict)  # of contacts, rays, cameras, IMUs
    motions: Mapping[str, MotionSet] = field(default_factory=dict)  # by the `file` of terms
    num_envs: Count = 1  # a run's own number takes its place
    spacing: NonNegative = 2.0  # m between neighbouring envs when several are drawn in one picture
    soft_joint_pos_limit_factor: Share = 1.0  # of each joint's range, about its middle

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of the smallest worlds."""
        return {("num_envs",): NUMBERS_PER_WORLD * self.num_envs}

    def _check_fields(self) -> None:
        super()._check_fields()
        for name in self.objects:
            if name in self.robots:
                raise ValueError(f"objects: {name!r} is the name of a robot: give it another")
        for name in self.placements:
            if name not in self.entities:
                raise ValueError(
                    f"placements: no robot or object {name!r}: {near(name, self.entities)}"
                )

    @property
    def entities(self) -> Mapping[str, Robot]:
        """Robots, then objects, by name."""
        return {**self.robots, **self.objects}


def warp_alone(cfg: SceneCfg) -> list[str]:
    """Return the parts of a scene that only MuJoCo Warp can do."""
    found = {sensor.warp_alone for sensor in cfg.sensors.values()}
    return sorted(found - {""})


def build_spec(cfg: SceneCfg) -> mujoco.MjSpec:
    """Assemble the scene's spec: robots and objects, then terrain, then sensors."""
    entities = {name: robot.spec() for name, robot in cfg.entities.items()}
    # Placed before joining: afterwards entities share one world.
    for name, placement in cfg.placements.items():
        placement.move(entities[name])
    # Names and complete keyframes are needed where entities are joined and compared.
    for entity in entities.values():
        _name_actuators(entity)
        complete_keyframes(entity)
    if len(entities) > 1:
        spec = joined(entities)
    else:
        spec = next(iter(entities.values()))
    if cfg.terrain is not None:
        # Sensors come last, since they may name the terrain.
        cfg.terrain.add_to(spec)
    for name, sensor in cfg.sensors.items():
        sensor.add_to(spec, name)
    return spec


def scene_spec(cfg: SceneCfg, sim: SimCfg) -> mujoco.MjSpec:
    """Return the spec of a scene under the options of `sim`."""
    spec = build_spec(cfg)
    sim.apply_to(spec)
    return spec


def load_scene(
    cfg: SceneCfg, sim: SimCfg, *, per_world_fields: Iterable[str] = ()
) -> mujoco.MjModel:
    """Return the model of a scene under the options of `sim`, in which worlds may differ in some fields."""
    spec = scene_spec(cfg, sim)
    # Before compilation, which may specialize these fields.
    prepare_spec(spec, per_world_fields)
    return load_model(spec)


def _name_actuators(spec: mujoco.MjSpec) -> None:
    """Name actuators without a name after the element that they drive, so that terms and exports can name them."""
    taken = {actuator.name for actuator in spec.actuators}
    for number, actuator in enumerate(spec.actuators):
        if actuator.name:
            continue
        # Named after its target, else by its number.
        name = actuator.target
        if not name or name in taken:
            name = f"actuator{number}"
        # A file may have given that name to another one.
        while name in taken:
            name += "_"
        actuator.name = name
        taken.add(name)
