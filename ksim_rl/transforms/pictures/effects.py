"""Effects on pictures, as data: each effect maps pictures [E, N, H, W, C] and draws per env to new pictures.

The N stacked pictures of an env are changed alike. Bytes are rounded to bytes; floats keep their dtype.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ksim_rl.checked import Checked, Count, NonNegative, NonNegativeRange, Positive, Range, Share

Pictures = Shaped[Tensor, "E N H W C"]
Changed = Shaped[Tensor, "E N H2 W2 C"]
Draws = Float[Tensor, "E K"]


@dataclass(frozen=True, kw_only=True)
class PictureEffect(Checked, ABC):
    """The base of effects.

    Attributes:
        each: draw in each env step, or once per episode.
    """

    kind: ClassVar[Literal["any", "light", "depth"]] = "any"
    """Which pictures it is for: of light, uint8 or floats in [0, 1]; of distances, floats in m."""
    is_normal: ClassVar[bool] = False
    """Whether the draws are standard normal, instead of uniform on [0, 1)."""

    each: Literal["step", "episode"] = "step"

    def num_draws(self, shape: Sequence[int]) -> int:
        """Return K, the numbers that one env needs for pictures [N, H, W, C]."""
        return 1

    def new_shape(self, shape: Sequence[int]) -> tuple[int, ...]:
        """Return the shape [N, H, W, C] of the results."""
        return tuple(shape)

    def new_ends(self, ends: Range, top: float) -> Range:
        """Return the smallest and the largest value of the results; `top` is full light."""
        return ends

    @abstractmethod
    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        """Return the new pictures."""


# -- of places ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RandomShift(PictureEffect):
    """Move pictures by up to `pixels` in each direction; edges are repeated (Yarats et al., arXiv 2107.09645)."""

    pixels: Count = 4

    def num_draws(self, shape: Sequence[int]) -> int:
        return 2

    def new_shape(self, shape: Sequence[int]) -> tuple[int, ...]:
        _check_size("pixels", self.pixels, shape, given=self.pixels)
        return tuple(shape)

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        height, width = pictures_ENHWC.shape[2:4]
        offset_E2 = (draws_EK * (2 * self.pixels + 1)).long() - self.pixels
        return _taken(pictures_ENHWC, offset_E2, height, width)


@dataclass(frozen=True, kw_only=True)
class RandomCrop(PictureEffect):
    """Cut out `height` x `width` pixels at a drawn place; in the middle while effects are off."""

    height: Count
    width: Count

    def num_draws(self, shape: Sequence[int]) -> int:
        return 2

    def new_shape(self, shape: Sequence[int]) -> tuple[int, ...]:
        frames, height, width, channels = shape
        if self.height > height or self.width > width:
            raise ValueError(
                f"height={self.height}, width={self.width}: the pictures have only {height} x {width} pixels"
            )
        return frames, self.height, self.width, channels

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        height, width = pictures_ENHWC.shape[2:4]
        row_E = draws_EK[:, 0] * (height - self.height + 1)
        column_E = draws_EK[:, 1] * (width - self.width + 1)
        offset_E2 = torch.stack((row_E, column_E), -1).long()
        return _taken(pictures_ENHWC, offset_E2, self.height, self.width)


# -- of light ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Light(PictureEffect):
    """The base of those that change the amount of light, between none and all."""

    kind = "light"

    def new_ends(self, ends: Range, top: float) -> Range:
        return 0.0, top


@dataclass(frozen=True, kw_only=True)
class Brightness(Light):
    """Multiply all pixels by a factor drawn from `factor`."""

    factor: NonNegativeRange = (0.7, 1.3)

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        factor_E1111 = _between(draws_EK, self.factor)
        return _light(pictures_ENHWC * factor_E1111, pictures_ENHWC)


@dataclass(frozen=True, kw_only=True)
class Contrast(Light):
    """Move all pixels away from the mean of their picture, or towards it, by a factor drawn from `factor`."""

    factor: NonNegativeRange = (0.7, 1.3)

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        values_ENHWC = pictures_ENHWC.float()
        mean_EN111 = values_ENHWC.mean((2, 3, 4), keepdim=True)
        factor_E1111 = _between(draws_EK, self.factor)
        return _light(mean_EN111 + (values_ENHWC - mean_EN111) * factor_E1111, pictures_ENHWC)


@dataclass(frozen=True, kw_only=True)
class Blur(Light):
    """Blur by a gaussian whose standard deviation is drawn from `sigma`, pixels; edges are repeated."""

    sigma: NonNegativeRange = (0.0, 1.0)

    @property
    def _reach(self) -> int:
        # Three standard deviations hold 99.7 % of the light; the number of pixels must not depend on the draw.
        return max(1, math.ceil(3 * self.sigma[1]))

    def new_shape(self, shape: Sequence[int]) -> tuple[int, ...]:
        _check_size("sigma", self._reach, shape, given=self.sigma)
        return tuple(shape)

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        reach = self._reach
        offset_K = torch.arange(-reach, reach + 1, device=draws_EK.device)
        # A width of zero would divide zero by zero in the middle.
        sigma_E1 = _between(draws_EK, self.sigma).flatten(1).clamp(min=1e-3)
        weight_EK = (-0.5 * (offset_K / sigma_E1).square()).softmax(-1)
        values_ENHWC = pictures_ENHWC.float()
        for dim in (2, 3):
            size = values_ENHWC.shape[dim]
            place = torch.arange(size, device=draws_EK.device)
            blurred = torch.zeros_like(values_ENHWC)
            for index in range(2 * reach + 1):
                neighbours = (place + offset_K[index]).clamp(0, size - 1)
                weight_E1111 = weight_EK[:, index, None, None, None, None]
                blurred = blurred + weight_E1111 * values_ENHWC.index_select(dim, neighbours)
            values_ENHWC = blurred
        return _light(values_ENHWC, pictures_ENHWC)


@dataclass(frozen=True, kw_only=True)
class PixelNoise(Light):
    """Add gaussian noise to each pixel, of a standard deviation `std` as a share of full light."""

    is_normal = True

    std: NonNegative = 0.02

    def num_draws(self, shape: Sequence[int]) -> int:
        return math.prod(shape)

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        noise_ENHWC = draws_EK.view(pictures_ENHWC.shape) * (self.std * top_of(pictures_ENHWC))
        return _light(pictures_ENHWC + noise_ENHWC, pictures_ENHWC)


@dataclass(frozen=True, kw_only=True)
class CutOut(Light):
    """Black out a rectangle, each of whose sides is drawn from `pixels`, at a drawn place (arXiv 1708.04552)."""

    pixels: NonNegativeRange = (4, 16)

    def num_draws(self, shape: Sequence[int]) -> int:
        return 4

    def new_shape(self, shape: Sequence[int]) -> tuple[int, ...]:
        _check_size("pixels", self.pixels[1], shape, given=self.pixels)
        return tuple(shape)

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        inside = []
        for axis, size in enumerate(pictures_ENHWC.shape[2:4]):
            side_E1 = _between(draws_EK[:, axis, None], self.pixels).flatten(1).round()
            # From where it begins within the picture, to where it still ends within.
            start_E1 = (draws_EK[:, axis + 2, None] * (size - side_E1 + 1)).floor().clamp(min=0)
            place = torch.arange(size, device=draws_EK.device)
            inside.append((place >= start_E1) & (place < start_E1 + side_E1))
        rows_EH, columns_EW = inside
        is_black_EHW = rows_EH[:, :, None] & columns_EW[:, None, :]
        return pictures_ENHWC.masked_fill(is_black_EHW[:, None, :, :, None], 0)


# -- of distances ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class DepthHoles(PictureEffect):
    """A `share` of the blocks of `pixels` x `pixels` has no reading, and shows `missing`, m."""

    kind = "depth"

    share: Share = 0.05
    pixels: Count = 2
    missing: float = 0.0

    def _blocks(self, shape: Sequence[int]) -> tuple[int, int]:
        return math.ceil(shape[1] / self.pixels), math.ceil(shape[2] / self.pixels)

    def num_draws(self, shape: Sequence[int]) -> int:
        return math.prod(self._blocks(shape))

    def new_shape(self, shape: Sequence[int]) -> tuple[int, ...]:
        _check_size("pixels", self.pixels, shape, given=self.pixels)
        return tuple(shape)

    def new_ends(self, ends: Range, top: float) -> Range:
        return _with(ends, self.missing)

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        height, width = pictures_ENHWC.shape[2:4]
        blocks = self._blocks(pictures_ENHWC.shape[1:])
        is_hole = (draws_EK < self.share).unflatten(1, blocks)
        # Blocks at the lower and the right edge may be cut off.
        for dim, size in ((1, height), (2, width)):
            is_hole = is_hole.repeat_interleave(self.pixels, dim).narrow(dim, 0, size)
        return pictures_ENHWC.masked_fill(is_hole[:, None, :, :, None], self.missing)


@dataclass(frozen=True, kw_only=True)
class DepthSteps(PictureEffect):
    """Round distances to multiples of `step`, m."""

    kind = "depth"

    step: Positive = 0.01

    def num_draws(self, shape: Sequence[int]) -> int:
        return 0

    def new_ends(self, ends: Range, top: float) -> Range:
        # Rounded as the values are, in float32.
        rounded = (torch.tensor(ends) / self.step).round() * self.step
        return float(rounded[0]), float(rounded[1])

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        # In float32: some meters are more steps than float16 has digits for.
        rounded_ENHWC = (pictures_ENHWC.float() / self.step).round() * self.step
        return rounded_ENHWC.to(pictures_ENHWC.dtype)


@dataclass(frozen=True, kw_only=True)
class DepthRange(PictureEffect):
    """Distances below or beyond `reach`, m, have no reading, and show `missing`, m."""

    kind = "depth"

    reach: Range = (0.2, 5.0)
    missing: float = 0.0

    def num_draws(self, shape: Sequence[int]) -> int:
        return 0

    def new_ends(self, ends: Range, top: float) -> Range:
        low, high = self.reach
        return _with((max(ends[0], low), min(ends[1], high)), self.missing)

    def __call__(self, pictures_ENHWC: Pictures, draws_EK: Draws) -> Changed:
        low, high = self.reach
        is_beyond = (pictures_ENHWC < low) | (pictures_ENHWC > high)
        return pictures_ENHWC.masked_fill(is_beyond, self.missing)


def _check_size(field: str, needed: float, shape: Sequence[int], *, given: object) -> None:
    """Refuse a field that needs more pixels than a side of pictures [N, H, W, C] has."""
    height, width = shape[1:3]
    if needed > min(height, width):
        raise ValueError(
            f"{field}={given}: it takes pictures of at least {math.ceil(needed)} pixels in height and width, and these "
            f"have {height} x {width}: choose less"
        )


def top_of(pictures: Shaped[Tensor, "*pictures"]) -> float:
    """Return what full light is: 255 of bytes, 1 of floats."""
    if pictures.dtype == torch.uint8:
        return 255.0
    return 1.0


def _with(ends: Range, value: float) -> Range:
    return min(ends[0], value), max(ends[1], value)


def _between(draws_EK: Tensor, ends: Range) -> Tensor:
    """Return one number per env between two, [E, 1, 1, 1, 1]."""
    low, high = ends
    return (low + draws_EK[:, 0] * (high - low))[:, None, None, None, None]


def _light(values: Tensor, pictures: Tensor) -> Tensor:
    """Return amounts of light in the dtype of the pictures, not below none and not above full light."""
    values = values.clamp(0.0, top_of(pictures))
    if pictures.dtype == torch.uint8:
        return values.round().to(torch.uint8)
    return values.to(pictures.dtype)


def _taken(pictures_ENHWC: Tensor, offset_E2: Tensor, height: int, width: int) -> Tensor:
    """Return `height` x `width` pixels from a row and a column on; beyond an edge its pixels are repeated."""
    device = offset_E2.device
    places = []
    for axis, (size, wanted) in enumerate(
        zip(pictures_ENHWC.shape[2:4], (height, width), strict=True)
    ):
        place = torch.arange(wanted, device=device) + offset_E2[:, axis, None]
        places.append(place.clamp(0, size - 1))
    rows_EH, columns_EW = places
    env_E11 = torch.arange(len(offset_E2), device=device)[:, None, None]
    # Bytes are gathered as bytes. What is indexed comes first, so that the frames go back to their place.
    taken_EHWNC = pictures_ENHWC[env_E11, :, rows_EH[:, :, None], columns_EW[:, None, :]]
    return taken_EHWNC.movedim(3, 1)
