"""Noise is described by the configs of this module, for `ObservationNoise` and the terms of observation groups."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from ksim_rl.checked import Checked, Share, Within

PerDim = float | tuple[float, ...]
"""One number, or one per element of the (flattened) observation."""
NonNegativePerDim = Annotated[PerDim, Within(low=0.0)]


@dataclass(frozen=True, kw_only=True)
class NoiseCfg(Checked, ABC):
    """The base of all noise: a sample is offset + spread * draw, which is added or multiplies the observation.

    A reading goes through it in this order: bias, walk, the noise itself, resolution, dropout. With `by_level` the
    transform's level (see `FollowsLevel`) scales all of it: a sample s becomes level * s ("multiply": 1 + level *
    (s - 1)), and walk, resolution and dropout are multiplied by the level.

    Args:
        bias: a further noise, drawn at each reset and held for the episode (an encoder's offset), with a separate
            operation; it has none of the fields below.
        walk_std: std of the steps of a random walk that is added (an IMU's drift), one per env step from 0 at a reset.
        resolution: the reading is rounded to a multiple of this; 0 does not round.
        dropout: chance per env step that the reading is lost, all its elements together; a reset's reading never is.
        lost: replacement of a lost reading: "last" is the one of the step before, "zero" is 0.
    """

    is_gaussian: ClassVar[bool] = False
    """Whether draws are standard normal, else uniform on [0, 1)."""

    operation: Literal["add", "multiply"] = "add"
    bias: "NoiseCfg | None" = None
    walk_std: NonNegativePerDim = 0.0
    resolution: NonNegativePerDim = 0.0
    dropout: Share = 0.0
    lost: Literal["last", "zero"] = "last"
    by_level: bool = False

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.bias is not None:
            # A bias is one draw per episode: features that change from step to step have no meaning for it.
            for field in ("bias", "walk_std", "resolution", "dropout", "by_level"):
                if getattr(self.bias, field) not in (None, 0.0):
                    raise ValueError(f"bias={self.bias!r}: a bias has no {field} of its own")

    @abstractmethod
    def affine(self, size: int) -> tuple[list[float], list[float]]:
        """Return offset and spread for each of `size` elements."""


@dataclass(frozen=True, kw_only=True)
class UniformNoise(NoiseCfg):
    """Noise uniform on [low, high)."""

    low: PerDim
    high: PerDim

    def _check_fields(self) -> None:
        super()._check_fields()
        low = _numbers(self.low)
        high = _numbers(self.high)
        if not low or not high or (len(low) != len(high) and 1 not in (len(low), len(high))):
            raise ValueError(
                f"low has {len(low)} numbers and high has {len(high)}: give as many, or one"
            )
        # One number stands for all elements: the shorter list repeats.
        width = max(len(low), len(high))
        if any(low[i % len(low)] > high[i % len(high)] for i in range(width)):
            raise ValueError(f"low={self.low!r} exceeds high={self.high!r}")

    def affine(self, size: int) -> tuple[list[float], list[float]]:
        low = per_dim("low", self.low, size)
        high = per_dim("high", self.high, size)
        return low, [b - a for a, b in zip(low, high, strict=True)]


@dataclass(frozen=True, kw_only=True)
class GaussianNoise(NoiseCfg):
    """Normal noise."""

    is_gaussian = True

    std: NonNegativePerDim
    mean: PerDim = 0.0

    def affine(self, size: int) -> tuple[list[float], list[float]]:
        return per_dim("mean", self.mean, size), per_dim("std", self.std, size)


@dataclass(frozen=True, kw_only=True)
class ConstantNoise(NoiseCfg):
    """The same value always; the default suits a sensor that only drifts, rounds or loses readings."""

    value: PerDim = 0.0

    def affine(self, size: int) -> tuple[list[float], list[float]]:
        # A spread of zero: nothing is drawn that counts.
        return per_dim("value", self.value, size), [0.0] * size


def per_dim(field: str, value: PerDim, size: int) -> list[float]:
    """Return one number for each of `size` elements; a ValueError refuses other lengths than 1 and `size`."""
    numbers = [float(number) for number in _numbers(value)]
    # A single number stands for all elements.
    if len(numbers) not in (1, size):
        raise ValueError(
            f"{field} has {len(numbers)} numbers, but the observation has {size} per env: give 1 or {size}"
        )
    if len(numbers) == 1:
        return numbers * size
    return numbers


def _numbers(value: PerDim) -> tuple[float, ...]:
    if isinstance(value, Sequence):
        return tuple(value)
    return (value,)
