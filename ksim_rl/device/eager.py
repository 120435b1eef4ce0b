"""Blocks in which nothing is compiled or recorded: all that is made there runs as it is written."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class _Depth(threading.local):
    """How many blocks of `eagerly` this thread is in."""

    blocks = 0


_depth = _Depth()


def runs_eagerly() -> bool:
    """Whether this thread is in a block of `eagerly`."""
    return _depth.blocks > 0


@contextmanager
def eagerly(wanted: bool = True) -> Iterator[None]:
    """Make each `Captured` that is made in this block one that never records a graph, where that is `wanted`."""
    _depth.blocks += wanted
    try:
        yield
    finally:
        _depth.blocks -= wanted
