"""Terrains are the ground of a scene: an endless plane, or a grid of patches of several kinds."""

from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.terrains.courses import (
    NarrowBeams,
    NestedRings,
    PerlinNoise,
    RandomBoxes,
    RandomGrid,
    RandomStairs,
    TiltedGrid,
)
from ksim_rl.scene.terrains.grid import PatchedGround, TerrainGrid
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
from ksim_rl.scene.terrains.terrain import GroundBox, PlaneTerrain, PlaneWithBoxes, Terrain

__all__ = sorted(name for name, value in vars().items() if isinstance(value, type))  # pyright: ignore
