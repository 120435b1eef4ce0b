"""Noise distributions, as parameters of `ObservationNoise` and of an observation group's terms."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Literal

from ksim_rl import checks

PerDim = float | tuple[float, ...]
"""One number, or one per element of the (flattened) observation."""


class Draw(Enum):
    """What a noise is made from: u on [0, 1), a standard normal, or nothing."""

    UNIFORM = "uniform"
    GAUSSIAN = "gaussian"
    NONE = "none"


@dataclass(frozen=True, kw_only=True)
class NoiseCfg(ABC):
    """What all noise has in common: a sample is offset + spread * draw.

    Args:
        operation: "add" (observation + sample) or "multiply" (observation * sample).
        bias: a further noise, drawn at each reset and held for the episode (an encoder's offset); its own operation
            applies, before the noise.
    """

    operation: Literal["add", "multiply"] = "add"
    bias: "NoiseCfg | None" = None

    def __post_init__(self) -> None:
        checks.check_choice("operation", self.operation, ("add", "multiply"))
        if self.bias is not None and self.bias.bias is not None:
            raise ValueError(f"bias={self.bias!r}: a bias has no bias of its own")

    @property
    @abstractmethod
    def draw(self) -> Draw:
        """The draw that the sample is made from."""

    @abstractmethod
    def affine(self, size: int) -> tuple[list[float], list[float]]:
        """Return offset and spread for each of `size` elements.

        Raises:
            ValueError: if a parameter has neither one number nor `size`.
        """


@dataclass(frozen=True, kw_only=True)
class UniformNoise(NoiseCfg):
    """Noise uniform on [low, high)."""

    low: PerDim
    high: PerDim

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = _checked("low", self.low), _checked("high", self.high)
        if len(low) != len(high) and 1 not in (len(low), len(high)):
            raise ValueError(f"low has {len(low)} numbers and high has {len(high)}: give as many, or one")
        width = max(len(low), len(high))
        if any(low[i % len(low)] > high[i % len(high)] for i in range(width)):
            raise ValueError(f"low={self.low!r} exceeds high={self.high!r}")

    @property
    def draw(self) -> Draw:
        """Uniform."""
        return Draw.UNIFORM

    def affine(self, size: int) -> tuple[list[float], list[float]]:
        """Offset low, spread high - low."""
        low, high = _per_dim("low", self.low, size), _per_dim("high", self.high, size)
        return low, [b - a for a, b in zip(low, high, strict=True)]


@dataclass(frozen=True, kw_only=True)
class GaussianNoise(NoiseCfg):
    """Normal noise."""

    std: PerDim
    mean: PerDim = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _checked("std", self.std, low=0.0)
        _checked("mean", self.mean)

    @property
    def draw(self) -> Draw:
        """Gaussian."""
        return Draw.GAUSSIAN

    def affine(self, size: int) -> tuple[list[float], list[float]]:
        """Offset mean, spread std."""
        return _per_dim("mean", self.mean, size), _per_dim("std", self.std, size)


@dataclass(frozen=True, kw_only=True)
class ConstantNoise(NoiseCfg):
    """The same value always."""

    value: PerDim

    def __post_init__(self) -> None:
        super().__post_init__()
        _checked("value", self.value)

    @property
    def draw(self) -> Draw:
        """None."""
        return Draw.NONE

    def affine(self, size: int) -> tuple[list[float], list[float]]:
        """Offset value, spread 0."""
        return _per_dim("value", self.value, size), [0.0] * size


def _numbers(value: PerDim) -> tuple[float, ...]:
    return tuple(value) if isinstance(value, Sequence) else (value,)


def _checked(field: str, value: PerDim, *, low: float | None = None) -> tuple[float, ...]:
    numbers = _numbers(value)
    for index, number in enumerate(numbers):
        checks.check_in_range(field if len(numbers) == 1 else f"{field}[{index}]", number, low=low)
    return numbers


def _per_dim(field: str, value: PerDim, size: int) -> list[float]:
    numbers = [float(number) for number in _numbers(value)]
    if len(numbers) not in (1, size):
        raise ValueError(
            f"{field} has {len(numbers)} numbers, but the observation has {size} per env: give 1 or {size}"
        )
    return numbers * size if len(numbers) == 1 else numbers
