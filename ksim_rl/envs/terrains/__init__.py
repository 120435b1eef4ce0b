"""Terrains: what a scene stands on."""

from ksim_rl.envs.terrains.flat import FlatPatch
from ksim_rl.envs.terrains.gaps import Gaps
from ksim_rl.envs.terrains.grid import TerrainGrid
from ksim_rl.envs.terrains.ground import Ground
from ksim_rl.envs.terrains.obstacles import DiscreteObstacles
from ksim_rl.envs.terrains.patch import Lattice, TerrainPatch
from ksim_rl.envs.terrains.patched_ground import PatchedGround
from ksim_rl.envs.terrains.plane import PlaneTerrain
from ksim_rl.envs.terrains.rough import RoughGround
from ksim_rl.envs.terrains.slope import PyramidSlope
from ksim_rl.envs.terrains.stairs import PyramidStairs
from ksim_rl.envs.terrains.stones import SteppingStones
from ksim_rl.envs.terrains.terrain import Terrain
from ksim_rl.envs.terrains.waves import Waves

__all__ = [
    "DiscreteObstacles",
    "FlatPatch",
    "Gaps",
    "Ground",
    "Lattice",
    "PatchedGround",
    "PlaneTerrain",
    "PyramidSlope",
    "PyramidStairs",
    "RoughGround",
    "SteppingStones",
    "Terrain",
    "TerrainGrid",
    "TerrainPatch",
    "Waves",
]
