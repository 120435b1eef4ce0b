"""Puts velocity tasks on stairs, slopes and rough ground, in levels of difficulty."""

import dataclasses
from collections.abc import Mapping, Sequence

from ksim_rl import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.scene import terrains
from ksim_rl.scene.robots.legged_robot import LeggedRobot
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.tasks import velocity
from ksim_rl.transforms.groups.group_cfg import ObservationTermCfg

PATCHES: Mapping[str, terrains.TerrainPatch] = {
    "flat": terrains.FlatPatch(),
    "stairs_down": terrains.PyramidStairs(proportion=2.0),
    "stairs_up": terrains.PyramidStairs(proportion=2.0, inverted=True),
    "slope_down": terrains.PyramidSlope(),
    "slope_up": terrains.PyramidSlope(inverted=True),
    "rough": terrains.RoughGround(),
    "obstacles": terrains.DiscreteObstacles(),
    "waves": terrains.Waves(),
}
"""Up to 20 cm of step and 27 degrees of slope. A pyramid's top is where envs start, so that they walk down."""

ILLEGAL = "illegal_contact"
"""The termination, and its sensor, of geoms that no walking robot touches the ground with."""


def on_rough_ground(
    flat: ManagerBasedRlEnvCfg, *, root_height: float, njmax: int, nconmax: int
) -> ManagerBasedRlEnvCfg:
    """Return the config of a flat velocity task on rough ground.

    Actor and critic see the heights around the robot, episodes also end (as truncations) at the edge of the patch, and
    envs move through the levels by how far their robots walk. Heights are seen relative to the soles of a robot whose
    root stands at `root_height`, m. `njmax` and `nconmax` make room for edges, where a foot touches in several places.
    """
    scan = mdp.HeightScan(offset=root_height)
    terrain = terrains.TerrainGrid(patches=PATCHES)
    groups = {}
    for name, seen in (
        ("actor", velocity.noisy(scan, 0.1)),
        ("critic", ObservationTermCfg(term=scan)),
    ):
        group = flat.observations[name]
        groups[name] = dataclasses.replace(group, terms={**group.terms, "height_scan": seen})
    return dataclasses.replace(
        flat,
        sim=dataclasses.replace(flat.sim, njmax=njmax, nconmax=nconmax),
        scene=dataclasses.replace(flat.scene, terrain=terrain, spacing=terrain.size),
        observations={**flat.observations, **groups},
        terminations={**flat.terminations, "outside_terrain": mdp.OutsideTerrain()},
        curriculum={
            **flat.curriculum,
            "terrain_level": mdp.TerrainLevels(command=velocity.COMMAND),
        },
    )


def rated_by_contacts(
    rough: ManagerBasedRlEnvCfg,
    robot: LeggedRobot,
    *,
    collides: Mapping[str, Sequence[str]],
    ends: Sequence[str],
    njmax: int,
    nconmax: int,
) -> ManagerBasedRlEnvCfg:
    """Return the config of a rough velocity task that is rated along the ground and by what the robot knocks against.

    This is what mjlab 1.6.0 does with Go1: `upright` is about the ground's normal, each substep in which the robot
    itself or a group of `collides` (geoms by the name of the reward) is hit by more than 10 N costs 0.1, and episodes
    end where one of the geoms `ends` is hit so, however the root is tilted. `njmax` and `nconmax` make room for robots
    that lie on the ground.
    """
    groups = {**collides, ILLEGAL: ends}
    touches = {}
    for name, geoms in groups.items():
        touches[name] = ContactSensor(geoms=tuple(geoms), reduce="strongest", every_substep=True)
    sensors = {**rough.scene.sensors, **touches, **velocity.self_contact(robot)}
    costs = {}
    for name, sensor in (("self_collisions", velocity.SELF), *zip(collides, collides, strict=True)):
        costs[name] = mdp.SelfCollision(weight=-0.1, sensor=sensor, threshold=10.0)
    upright = dataclasses.replace(rough.rewards["upright"], along="ground")
    terminations = {name: term for name, term in rough.terminations.items() if name != "fell_over"}
    return dataclasses.replace(
        rough,
        sim=dataclasses.replace(rough.sim, njmax=njmax, nconmax=nconmax),
        scene=dataclasses.replace(rough.scene, sensors=sensors),
        rewards={**rough.rewards, "upright": upright, **costs},
        terminations={**terminations, ILLEGAL: mdp.IllegalContact(sensor=ILLEGAL, threshold=10.0)},
    )
