"""This module describes left-right mirror images of vectors as permutations with signs."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int64, Num
from torch import Tensor

from ksim_rl import checks
from ksim_rl.transforms.specs import Device


@dataclass(frozen=True, kw_only=True)
class MirrorMap:
    """The mirror image of a vector: `mirrored[i] = signs[i] * vector[source[i]]`.

    The mirror image of a mirror image is the vector itself; maps for which it is not are refused.

    Args:
        source: column that each column of the image shows.
        signs: 1 or -1 per column; those of None are 1.
    """

    source: tuple[int, ...]
    signs: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", tuple(self.source))
        object.__setattr__(self, "signs", tuple(float(s) for s in self.signs) or (1.0,) * len(self.source))
        if sorted(self.source) != list(range(len(self.source))):
            raise ValueError(f"source={self.source}: expected each of 0 to {len(self.source) - 1} once")
        if len(self.signs) != len(self.source):
            raise ValueError(f"signs has {len(self.signs)} numbers for the {len(self.source)} of source")
        for index, (source, sign) in enumerate(zip(self.source, self.signs, strict=True)):
            checks.check_choice(f"signs[{index}]", sign, (1.0, -1.0))
            if self.source[source] != index or self.signs[source] != sign:
                raise ValueError(
                    f"columns {index} and {source} are no mirror images of each other: "
                    f"source {source} and {self.source[source]}, signs {sign} and {self.signs[source]}"
                )

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.source)

    def __call__(self, vector: Num[Tensor, "*batch L"]) -> Num[Tensor, "*batch L"]:
        """Return the mirror image of vectors [..., L]."""
        return image(vector, *self.tensors(vector.device))

    def tensors(self, device: Device) -> tuple[Int64[Tensor, " L"] | None, Float32[Tensor, " L"]]:
        """Return source (int64; None if no column moves) and signs (float32), [L]."""
        return _tensors(self, device)

    def repeat(self, times: int) -> "MirrorMap":
        """Return the map of `times` such vectors one after another: a flat history, say."""
        return concatenate([self] * times)


def image(
    vector: Num[Tensor, "*batch L"], source_L: Int64[Tensor, " L"] | None, signs_L: Float32[Tensor, " L"]
) -> Num[Tensor, "*batch L"]:
    """Return the mirror image of vectors [..., L]; a `source_L` of None leaves the columns in place."""
    columns = vector if source_L is None else vector.index_select(-1, source_L)
    return columns * signs_L.to(vector.dtype)


@functools.lru_cache(maxsize=256)
def _tensors(mirror: MirrorMap, device: Device) -> tuple[Tensor | None, Tensor]:
    moves = mirror.source != tuple(range(mirror.size))
    source_L = torch.tensor(mirror.source, device=device) if moves else None
    return source_L, torch.tensor(mirror.signs, device=device)


def concatenate(maps: Sequence[MirrorMap]) -> MirrorMap:
    """Return the map of the vectors of `maps` one after another."""
    source: list[int] = []
    signs: list[float] = []
    for mirror in maps:
        start = len(source)
        source += [start + column for column in mirror.source]
        signs += mirror.signs
    return MirrorMap(source=tuple(source), signs=tuple(signs))


def unchanged(size: int) -> MirrorMap:
    """Return the map of a vector that is its own mirror image: heights, phases common to both sides."""
    return MirrorMap(source=tuple(range(size)))


POLAR = MirrorMap(source=(0, 1, 2), signs=(1, -1, 1))
"""Position, linear velocity, acceleration, force, projected gravity (x forward, y left, z up)."""
AXIAL = MirrorMap(source=(0, 1, 2), signs=(-1, 1, -1))
"""Angular velocity, torque (x forward, y left, z up)."""
PLANAR_VELOCITY = MirrorMap(source=(0, 1, 2), signs=(1, -1, -1))
"""The velocity command (vx, vy, wz)."""
QUATERNION = MirrorMap(source=(0, 1, 2, 3), signs=(1, -1, 1, -1))
"""Orientation (w, x, y, z)."""
