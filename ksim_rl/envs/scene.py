"""The scene of one world: robots on a terrain, with the sensors that terms read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import mujoco

from ksim_rl.checks import check_in_range
from ksim_rl.envs.sensors import ContactSensor
from ksim_rl.physics import load_model, load_spec


@runtime_checkable
class Robot(Protocol):
    """What a scene needs from a robot: its model, as a spec that can still be edited."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the robot; its first keyframe, if any, is the default pose."""
        ...


@dataclass(frozen=True, kw_only=True)
class MjcfRobot:
    """A robot, or a whole scene, as an MJCF file, an XML string or a menagerie name.

    Attributes:
        source: what `physics.load_spec` takes.
    """

    source: str

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        return load_spec(self.source)


@dataclass(frozen=True, kw_only=True)
class PlaneTerrain:
    """An infinite plane at z = 0: body and geom are both called "terrain".

    Attributes:
        friction: sliding (1), torsional (m) and rolling (m) coefficients, as in MJCF.
    """

    friction: tuple[float, float, float] = (1.0, 0.005, 0.0001)

    def __post_init__(self) -> None:
        for index, value in enumerate(self.friction):
            check_in_range(f"friction[{index}]", value, low=0.0)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the plane to the world body, with a checker pattern and a sky for rendering."""
        if not any(texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
            spec.add_texture(
                name="terrain_sky",
                type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
                builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
                rgb1=[0.75, 0.82, 0.9],
                rgb2=[0.95, 0.97, 1.0],
                width=64,
                height=384,
            )
        spec.add_texture(
            name="terrain",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            rgb1=[0.28, 0.32, 0.36],
            rgb2=[0.22, 0.25, 0.29],
            width=256,
            height=256,
        )
        textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "terrain"
        spec.add_material(name="terrain", textures=textures, texuniform=True, texrepeat=[2, 2])
        spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
        spec.worldbody.add_body(name="terrain").add_geom(
            name="terrain",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 0.01],
            friction=list(self.friction),
            material="terrain",
        )


@dataclass(frozen=True, kw_only=True)
class SceneCfg:
    """What is in each world.

    Attributes:
        robots: by name. The elements of a single robot keep their names; those of several get the prefix "<name>/". All
            start at their own default poses; gravity and the other options are the first robot's.
        terrain: the ground, or None if the robot's own model has what it needs.
        sensors: contact sensors by name, for `view.contact(name)`. Sensors of the MJCF need no entry here.
        num_envs: E, the number of worlds.
        spacing: m between neighbouring envs when several are drawn in one picture.
        soft_joint_pos_limit_factor: fraction of each joint's range, about its middle, that counts as soft limits.
    """

    robots: Mapping[str, Robot]
    terrain: PlaneTerrain | None = None
    sensors: Mapping[str, ContactSensor] = field(default_factory=dict)
    num_envs: int = 1
    spacing: float = 2.0
    soft_joint_pos_limit_factor: float = 1.0

    def __post_init__(self) -> None:
        if not self.robots:
            raise ValueError("robots={}: name at least one robot")
        if isinstance(self.num_envs, bool) or not isinstance(self.num_envs, int) or self.num_envs < 1:
            raise ValueError(f"num_envs={self.num_envs!r}: expected a whole number of at least 1")
        check_in_range("spacing", self.spacing, low=0.0)
        check_in_range("soft_joint_pos_limit_factor", self.soft_joint_pos_limit_factor, low=0.0, high=1.0)


def build_spec(cfg: SceneCfg) -> mujoco.MjSpec:
    """Assemble the scene's spec: robots, then terrain, then sensors.

    Raises:
        ValueError: if a robot cannot be loaded or a sensor names what the model does not have.
    """
    if len(cfg.robots) == 1:
        (robot,) = cfg.robots.values()
        spec = robot.spec()
    else:
        spec = _joined({name: robot.spec() for name, robot in cfg.robots.items()})
    if cfg.terrain is not None:
        cfg.terrain.add_to(spec)
    for name, sensor in cfg.sensors.items():
        sensor.add_to(spec, name)
    return spec


def _joined(robots: Mapping[str, mujoco.MjSpec]) -> mujoco.MjSpec:
    """Put robots into one spec, with one keyframe that holds the default pose of each."""
    spec = mujoco.MjSpec()
    first = next(iter(robots.values()))
    spec.option = first.option
    pose: list[float] = []
    for name, robot in robots.items():
        robot.option = first.option
        model = load_model(robot)
        pose += list(model.key_qpos[0] if model.nkey else model.qpos0)
        # An attached keyframe would cover its own robot only.
        for key in list(robot.keys):
            robot.delete(key)
        spec.attach(robot, prefix=f"{name}/", frame=spec.worldbody.add_frame())
    spec.add_key(name="default", qpos=pose)
    return spec
