"""A run's clock measures wall time: in all, per iteration, and what is left."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager


class RunClock:
    """Measures iterations; evaluations and checkpoints count in the total, not in an iteration.

    Attributes:
        total: s, over all sessions of a resumed run.
    """

    def __init__(self) -> None:
        self.total = 0.0
        self._last: float | None = None
        self._laps: deque[float] = deque(maxlen=20)
        self._created = time.monotonic()

    def lap(self) -> float:
        """End an iteration, and return its seconds."""
        now = time.monotonic()
        seconds = max(now - (self._created if self._last is None else self._last), 1e-9)
        # The first iteration compiles kernels, so it says nothing about the rest.
        if self._last is not None:
            self._laps.append(seconds)
        self.total += seconds
        self._last = now
        return seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leave what happens inside out of the iteration."""
        start = time.monotonic()
        yield
        elapsed = time.monotonic() - start
        self.total += elapsed
        if self._last is not None:
            self._last += elapsed

    def seconds_left(self, iterations: int) -> float | None:
        """Estimate the time for so many more iterations from the latest ones; None before the second."""
        if not self._laps:
            return None
        return iterations * sum(self._laps) / len(self._laps)
