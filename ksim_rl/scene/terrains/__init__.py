"""Terrains are what a scene stands on: an endless plane, or a grid of patches of several kinds."""

from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.terrains.grid import TerrainGrid
from ksim_rl.scene.terrains.kinds import (
    DiscreteObstacles,
    FlatPatch,
    Gaps,
    PyramidSlope,
    PyramidStairs,
    RoughGround,
    SteppingStones,
    Waves,
)
from ksim_rl.scene.terrains.patch import Lattice, TerrainPatch
from ksim_rl.scene.terrains.patched_ground import PatchedGround
from ksim_rl.scene.terrains.terrain import PlaneTerrain, Terrain

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
