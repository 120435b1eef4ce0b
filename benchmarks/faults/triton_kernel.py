"""A kernel for Triton, which reads the source of its file."""

import triton.language as tl


def twice(x, n: tl.constexpr):
    """Double `n` numbers."""
    at = tl.arange(0, n)
    tl.store(x + at, 2.0 * tl.load(x + at))
