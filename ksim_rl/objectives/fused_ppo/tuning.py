"""This module has the sizes of the kernels' blocks; they change the speed and the order of sums, nothing else."""

import math
from dataclasses import dataclass

from ksim_rl.objectives.fused_ppo.layout import FusedLayout


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """How the work is cut. The defaults were the fastest on an H200 for layers of 512, 256 and 128.

    Attributes:
        block: rows of a minibatch that one program takes through a network.
        chunk: columns of the widest layer that exist at a time.
        stages: how far loads of weights run ahead.
        warps: of such a program.
        tile: rows and columns of the weights whose gradient one program computes.
        depth: rows of a minibatch that it multiplies at a time.
        tile_stages, tile_warps: as `stages` and `warps`.
        splits: programs that share a tile, each with a part of the minibatch.
        size: elements per program in sums and Adam.
        columns, rows: of the blocks in which sums over programs are taken.
    """

    block: int = 64
    chunk: int = 32
    stages: int = 3
    warps: int = 4
    tile: int = 128
    depth: int = 64
    tile_stages: int = 3
    tile_warps: int = 8
    splits: int = 8
    size: int = 1024
    columns: int = 32
    rows: int = 64

    @classmethod
    def of(cls, layout: FusedLayout) -> "Tuning":
        """Return what suits networks of a layout: the first and the third width must be whole numbers of chunks."""
        return cls(chunk=math.gcd(cls.chunk, layout.hidden[0], layout.hidden[2]))
