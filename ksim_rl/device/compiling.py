"""Compiles functions so that equal runs have equal bits."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

from ksim_rl.device.eager import runs_eagerly

P = ParamSpec("P")
R = TypeVar("R")


def compiled(work: Callable[P, R], *, device: torch.device, wanted: bool = True) -> Callable[P, R]:
    """Return `work` compiled as one graph of fixed sizes where that is `wanted` on a CUDA device, else `work` itself.

    In a block of `eagerly` it is not wanted.

    Left alone, the compiler times two sizes of blocks for sums that need many registers, at the first call of each
    object again. The winner of a close race is another each time, and adds in another order. So it is set to leave out
    what it cannot time without changing bits.
    """
    if not wanted or device.type != "cuda" or runs_eagerly():
        return work
    return torch.compile(work, fullgraph=True, dynamic=False, options={"deterministic": True})
