"""Makes each wait of the host for the GPU an error."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def no_syncs(*, on: bool = True) -> Iterator[None]:
    """Let no operation of this block wait for the GPU; with `on=False`, as before a graph is ready, any may."""
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error" if on else "default")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")
