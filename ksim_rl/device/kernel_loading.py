"""Loads the kernels of many launches at once: compiled one after another, a new model takes half a minute."""

import os
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import warp as wp

from ksim_rl.device.streams import warp_device

# A process with more compilers than this waits for its disk.
MOST_WORKERS = 16

_lock = threading.Lock()


@contextmanager
def loaded_together(device: torch.device) -> Iterator[None]:
    """Run none of the launches that this thread issues in this block, but load their kernels, side by side, at its end.

    Loops of Warp (`wp.capture_while`) go through their body once. Kernels that take their types from a launch are left
    to that launch.
    """
    warp_dev = warp_device(device)
    modules: dict[int | None, dict[wp.Module, None]] = defaultdict(dict)
    thread = threading.get_ident()

    def note(kernel: wp.Kernel, dim: Any, block_dim: int | None) -> None:
        size = dim if isinstance(dim, (tuple, list)) else (dim,)
        if all(size) and not kernel.is_generic:
            modules[None if device.type == "cpu" else block_dim][kernel.module] = None

    with _lock:
        launch, launch_tiled, capture_while = wp.launch, wp.launch_tiled, wp.capture_while

        def noted(kernel: wp.Kernel, dim: Any, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != thread:
                return launch(kernel, dim, *args, **kwargs)
            return note(kernel, dim, kwargs.get("block_dim"))

        def noted_tiled(kernel: wp.Kernel, dim: Any, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != thread:
                return launch_tiled(kernel, dim, *args, **kwargs)
            return note(kernel, dim, kwargs.get("block_dim"))

        def once(condition: Any, while_body: Any, *args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != thread:
                return capture_while(condition, while_body, *args, **kwargs)
            return while_body(**kwargs)

        namespace: Any = vars(wp)
        instead = {"launch": noted, "launch_tiled": noted_tiled, "capture_while": once}
        saved = {"launch": launch, "launch_tiled": launch_tiled, "capture_while": capture_while}
        namespace.update(instead)
        try:
            yield
        finally:
            namespace.update(saved)
    workers = min(os.cpu_count() or 1, MOST_WORKERS)
    for block_dim, found in modules.items():
        wp.force_load(warp_dev, modules=list(found), block_dim=block_dim, max_workers=workers)
