"""This module starts Triton kernels."""

from typing import Any


def launch(kernel: Any, grid: tuple[int, ...], *args: Any, **options: Any) -> None:
    """Run `grid` programs of a Triton kernel, whose signature type checkers cannot read, on the current stream."""
    kernel[grid](*args, **options)


def parts(total: int, size: int) -> int:
    """Return how many programs of `size` elements cover `total`."""
    return -(-total // size)
