"""What velocity tasks on rough ground share: the flat task's managers, a terrain in levels, and a scan of it."""

import dataclasses
from collections.abc import Mapping

from ksim_rl.envs import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.robots.legged_robot import LeggedRobot
from ksim_rl.envs.sensors import ContactSensor
from ksim_rl.envs.tasks import velocity
from ksim_rl.envs.term import EventTerm, RewardTerm
from ksim_rl.envs.terrains import (
    DiscreteObstacles,
    FlatPatch,
    PyramidSlope,
    PyramidStairs,
    RoughGround,
    TerrainGrid,
    TerrainPatch,
    Waves,
)
from ksim_rl.envs.transforms.group_cfg import ObservationTermCfg
from ksim_rl.envs.viewer_cfg import ViewerCfg
from ksim_rl.physics import SimCfg

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
"""For robots of about Go1's size. A pyramid's top is where envs start, so that they walk down."""


def with_room(sim: SimCfg, *, njmax: int, nconmax: int) -> SimCfg:
    """Return the settings with room for more constraints and contacts: on edges a foot touches in several places."""
    return dataclasses.replace(sim, njmax=njmax, nconmax=nconmax)


def velocity_rough_cfg(
    robot: LeggedRobot,
    *,
    sim: SimCfg,
    feet: ContactSensor,
    rewards: Mapping[str, RewardTerm],
    events: Mapping[str, EventTerm],
    viewer: ViewerCfg,
    root_height: float,
    patches: Mapping[str, TerrainPatch] = PATCHES,
) -> ManagerBasedRlEnvCfg:
    """Return the config of `velocity.velocity_cfg` on rough ground.

    Actor and critic see the heights around the robot, episodes also end (as truncations) at the edge of the patch, and
    envs move through the levels by how far their robots walk.

    Args:
        root_height: m, of the robot as it stands; the heights are seen relative to its soles.
    """
    scan, terrain = mdp.HeightScan(offset=root_height), TerrainGrid(patches=patches)
    cfg = velocity.velocity_cfg(
        robot,
        sim=sim,
        feet=feet,
        observations=velocity.observations(
            robot,
            actor={"height_scan": velocity.noisy(scan, 0.1)},
            critic={"height_scan": ObservationTermCfg(term=scan)},
        ),
        rewards=rewards,
        events=events,
        viewer=viewer,
        terrain=terrain,
        curriculum={"terrain_level": mdp.TerrainLevels(command=velocity.COMMAND)},
    )
    return dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, spacing=terrain.size),
        terminations={**cfg.terminations, "outside_terrain": mdp.OutsideTerrain()},
    )
