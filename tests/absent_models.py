"""Skips tests whose models are not on this machine and cannot be downloaded."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

WORDS = ("menagerie", "ksim_rl[dm_control]", "ksim_rl[playground]")
"""What the errors of missing models say; each names one model."""


@contextmanager
def skipped_without_models() -> Iterator[None]:
    """Skip the test if what the block builds needs a model that is not here; all other errors are raised."""
    try:
        yield
    except ValueError as error:
        if not any(word in str(error) for word in WORDS):
            raise
        pytest.skip(str(error))
