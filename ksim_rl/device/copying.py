"""Copies the rows of many tensors with one kernel; torch takes several times as long where rows are few."""

from collections.abc import Sequence
from functools import cache

from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.device import headers
from ksim_rl.device.quick_launch import ADDRESS, QuickLaunch, arguments_of

LANES = 32
_COPY = headers.text_of("ksim_rl/device/copying.cuh", {"LANES": LANES})


def copy_rows(
    to: Sequence[Shaped[Tensor, " E *?leaf"]], given: Sequence[Shaped[Tensor, " E *?leaf"]]
) -> None:
    """Copy tensors of one device into others of the same shapes and types; a row's numbers lie in one piece."""
    addresses: list[int] = []
    layouts: list[tuple[int, int, int, int]] = []
    for own, new in zip(to, given, strict=True):
        assert own.shape == new.shape and own.dtype == new.dtype, "a copy of rows changes nothing"
        # The kernel is for GPUs, and for rows that lie in one piece.
        if own.device.type == "cpu" or not new[:1].is_contiguous():
            own.copy_(new)
        elif own.numel():
            size = own.element_size()
            sizes = own[0].nbytes, own.stride(0) * size, new.stride(0) * size
            pair = own.data_ptr(), new.data_ptr()
            # Copied as ints where all sizes and addresses allow it, or else byte by byte.
            if any(number % 4 for number in (*sizes, *pair)):
                unit = 1
            else:
                unit = 4
            addresses += pair
            width, stride, stride_of_new = (number // unit for number in sizes)
            layouts.append((unit, width, stride, stride_of_new))
    if layouts:
        _launcher(tuple(layouts))(to[0].device, (to[0].shape[0], LANES), *addresses)


@cache
def _launcher(layouts: tuple[tuple[int, int, int, int], ...]) -> QuickLaunch:
    """Return the copy of tensors, each in units of so many bytes: of a row, and from row to row in both."""
    # Sizes are compiled in, so that the kernel needs addresses only.
    lines: list[str] = []
    for place, (unit, *sizes) in enumerate(layouts):
        kind = "int" if unit == 4 else "char"
        numbers = ", ".join(map(str, sizes))
        tensors = f"({kind}*)a.to_{place}, (const {kind}*)a.from_{place}"
        lines.append(f"copying::copy_row(row, lane, {tensors}, {numbers});")
    fields = " ".join(f"to_{place} from_{place}" for place in range(len(layouts)))
    return QuickLaunch(arguments_of((ADDRESS, fields)), "\n".join(lines), preamble=_COPY)
