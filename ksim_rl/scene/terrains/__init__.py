"""Terrains: what a scene stands on."""

from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.terrains.flat import FlatPatch
from ksim_rl.scene.terrains.gaps import Gaps
from ksim_rl.scene.terrains.grid import TerrainGrid
from ksim_rl.scene.terrains.obstacles import DiscreteObstacles
from ksim_rl.scene.terrains.patch import Lattice, TerrainPatch
from ksim_rl.scene.terrains.patched_ground import PatchedGround
from ksim_rl.scene.terrains.plane import PlaneTerrain
from ksim_rl.scene.terrains.rough import RoughGround
from ksim_rl.scene.terrains.slope import PyramidSlope
from ksim_rl.scene.terrains.stairs import PyramidStairs
from ksim_rl.scene.terrains.stones import SteppingStones
from ksim_rl.scene.terrains.terrain import Terrain
from ksim_rl.scene.terrains.waves import Waves

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
