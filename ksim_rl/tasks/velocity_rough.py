"""Velocity tasks on rough ground are the flat task with a terrain in levels and a scan of it."""

import dataclasses
from collections.abc import Mapping

from ksim_rl import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.terrains import (
    DiscreteObstacles,
    FlatPatch,
    PyramidSlope,
    PyramidStairs,
    RoughGround,
    TerrainGrid,
    TerrainPatch,
    Waves,
)
from ksim_rl.tasks import velocity, velocity_flat
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

PATCHES: Mapping[str, TerrainPatch] = {
    "flat": FlatPatch(),
    "stairs_down": PyramidStairs(proportion=2.0),
    "stairs_up": PyramidStairs(proportion=2.0, inverted=True),
    "slope_down": PyramidSlope(),
    "slope_up": PyramidSlope(inverted=True),
    "rough": RoughGround(),
    "obstacles": DiscreteObstacles(),
    "waves": Waves(),
}
"""Up to 20 cm of step and 27 degrees of slope. A pyramid's top is where envs start, so that they walk down."""


def on_rough_ground(
    flat: ManagerBasedRlEnvCfg,
    *,
    root_height: float,
    njmax: int,
    nconmax: int,
    patches: Mapping[str, TerrainPatch] = PATCHES,
) -> ManagerBasedRlEnvCfg:
    """Return the config of a flat velocity task on rough ground.

    Actor and critic see the heights around the robot, episodes also end (as truncations) at the edge of the patch, and
    envs move through the levels by how far their robots walk.

    Args:
        root_height: m, of the robot as it stands; heights are seen relative to its soles.
        njmax, nconmax: room for constraints and contacts; on edges a foot touches in several places.
    """
    scan, terrain = mdp.HeightScan(offset=root_height), TerrainGrid(patches=patches)
    groups = {
        "actor": _with(flat.observations["actor"], velocity.noisy(scan, 0.1)),
        "critic": _with(flat.observations["critic"], ObservationTermCfg(term=scan)),
    }
    return dataclasses.replace(
        flat,
        sim=dataclasses.replace(flat.sim, njmax=njmax, nconmax=nconmax),
        scene=dataclasses.replace(flat.scene, terrain=terrain, spacing=terrain.size),
        observations={**flat.observations, **groups},
        terminations={**flat.terminations, "outside_terrain": mdp.OutsideTerrain()},
        curriculum={**flat.curriculum, "terrain_level": mdp.TerrainLevels(command=velocity.COMMAND)},
    )


def _with(group: ObservationGroupCfg, scan: ObservationTermCfg) -> ObservationGroupCfg:
    return dataclasses.replace(group, terms={**group.terms, "height_scan": scan})


def go1_velocity_rough() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree Go1."""
    flat, height = velocity_flat.go1_velocity_flat(), velocity_flat.GO1_ROBOT.init_pos[2]
    return on_rough_ground(flat, root_height=height, njmax=120, nconmax=40)


def g1_velocity_rough() -> ManagerBasedRlEnvCfg:
    """Return the config of Unitree G1."""
    flat, height = velocity_flat.g1_velocity_flat(), velocity_flat.G1_ROBOT.init_pos[2]
    return on_rough_ground(flat, root_height=height, njmax=250, nconmax=80)


GO1 = Task(
    name="go1_velocity_rough",
    description="Unitree Go1 follows a velocity command over stairs, slopes and rough ground",
    cfg=go1_velocity_rough,
    training=velocity.training(num_iterations=10_000),
)
G1 = Task(
    name="g1_velocity_rough",
    description="Unitree G1 follows a velocity command over stairs, slopes and rough ground",
    cfg=g1_velocity_rough,
    training=velocity.training(num_iterations=30_000),
)
