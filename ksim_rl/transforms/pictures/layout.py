"""In which order the dims of a picture stand, and how each order is read as one: frames, rows, columns, channels."""

from collections.abc import Sequence
from typing import Literal

from jaxtyping import Shaped
from torch import Tensor

Layout = Literal["HWC", "CHW"]


def check_layout(shape: Sequence[int], layout: Layout) -> None:
    """Refuse a shape of one env that is none of [H, W], [H, W, C] and stacked [N, H, W, C], or is in another order."""
    dims = list(shape)
    if len(dims) not in (2, 3, 4):
        raise ValueError(
            f"it reads pictures [H, W], [H, W, C] or stacked ones [N, H, W, C], and these are {dims}"
        )
    if len(dims) == 2:
        return
    sides = dims[-3:]
    channels = sides.pop(layout.index("C"))
    # Frames of a depth camera, [N, H, W], would be read as very low pictures with W channels.
    if channels > min(sides):
        raise ValueError(
            f"layout={layout!r} gives pictures {dims} {channels} channels, more than rows or columns: choose the "
            "other, as for stacked [N, H, W]"
        )


def framed(pictures: Shaped[Tensor, " E *leaf"], layout: Layout) -> Shaped[Tensor, "E N H W C"]:
    """Return pictures of any shape that `check_layout` takes as [E, N, H, W, C]; a view."""
    if pictures.ndim == 3:
        return pictures[:, None, :, :, None]
    if layout == "CHW":
        pictures = pictures.movedim(-3, -1)
    if pictures.ndim == 4:
        return pictures[:, None]
    return pictures


def unframed(
    pictures_ENHWC: Shaped[Tensor, "E N H W C"], num_dims: int, layout: Layout
) -> Shaped[Tensor, " E *leaf"]:
    """Return pictures as `framed` found them, with `num_dims` dims in each env."""
    if num_dims == 2:
        return pictures_ENHWC[:, 0, :, :, 0]
    pictures = pictures_ENHWC
    if layout == "CHW":
        pictures = pictures.movedim(-1, -3)
    if num_dims == 3:
        return pictures[:, 0]
    return pictures
