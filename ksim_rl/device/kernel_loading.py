"""This module loads the kernels of many launches at once: one after another, a new model takes half a minute."""

import os
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import warp as wp

from ksim_rl.device import upstream
from ksim_rl.device.streams import warp_device

# A process with more compilers than this waits for its disk.
MOST_WORKERS = 16


@contextmanager
def loaded_together(device: torch.device) -> Iterator[None]:
    """Run none of the launches that this thread issues in this block, but load their kernels, side by side, at its end.

    Loops of Warp (`wp.capture_while`) go through their body once. Kernels that take their types from a launch are left
    to that launch.
    """
    modules: dict[int | None, dict[wp.Module, None]] = defaultdict(dict)

    def note(kernel: wp.Kernel, dim: Any, block_dim: int | None) -> None:
        size = dim if isinstance(dim, (tuple, list)) else (dim,)
        if all(size) and not kernel.is_generic:
            modules[None if device.type == "cpu" else block_dim][kernel.module] = None

    with upstream.launches_diverted(note):
        yield
    workers = min(os.cpu_count() or 1, MOST_WORKERS)
    for block_dim, found in modules.items():
        wp.force_load(warp_device(device), modules=list(found), block_dim=block_dim, max_workers=workers)
