"""Keeps a loop's rate by deadlines, and tells how far off it was."""

import math
import os
import time
from pathlib import Path

import numpy as np

from ksim_rl.export.standalone.files import Json

RESOLUTION = 1e-5
"""s, of the times that are reported."""
MOST_BINS = 10_000
MEMORY_EVERY_S = 5.0


class MonotonicClock:
    """The computer's clock."""

    def now(self) -> float:
        """Return the time, s."""
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        """Return at a time, or at once where it has passed."""
        left = deadline - time.monotonic()
        if left > 0.0:
            time.sleep(left)


class Durations:
    """How often durations were how long, in memory that does not grow."""

    def __init__(self) -> None:
        self.counts = np.zeros(MOST_BINS, np.int64)
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """Count one duration; those beyond the last bin are counted in it."""
        place = int(seconds / RESOLUTION)
        self.counts[min(max(place, 0), MOST_BINS - 1)] += 1
        self.longest = max(self.longest, seconds)

    def quantile(self, share: float) -> float:
        """Return the duration that a share of all did not exceed, to `RESOLUTION`; NaN where there are none."""
        total = int(self.counts.sum())
        if not total:
            return math.nan
        place = int(np.searchsorted(np.cumsum(self.counts), share * total))
        return min((place + 1) * RESOLUTION, self.longest)

    def count_beyond(self, seconds: float) -> int:
        """Return how many durations were longer, to `RESOLUTION`."""
        return int(self.counts[int(seconds / RESOLUTION) + 1 :].sum())


class Punctuality:
    """How punctual a loop was.

    A period begins at its deadline. `woken` is how late the loop ran then, which is the scheduler's; `own` is the time
    from there until the command was handed to the robot, which is the loop's. Its own jitter is how much longer than
    the median that was.
    """

    def __init__(self) -> None:
        self.woken = Durations()
        self.own = Durations()
        self.late = Durations()
        self.periods = 0
        self.missed = 0
        self.memory: list[float] = []
        self.memory_at = -math.inf

    def add(self, deadline: float, woken: float, sent: float) -> None:
        """Count a period: when it was to begin, when the loop ran, and when its command went out, s."""
        self.periods += 1
        self.woken.add(woken - deadline)
        self.own.add(sent - woken)
        self.late.add(sent - deadline)
        if sent - self.memory_at >= MEMORY_EVERY_S:
            self.memory_at = sent
            self._keep_memory()

    def _keep_memory(self) -> None:
        self.memory.append(resident_mib())
        # At most 1000 numbers: every other one goes then, but the first stays.
        if len(self.memory) > 1000:
            del self.memory[1::2]

    def summary(self) -> Json:
        """Return the figures, in ms and MiB, of at least one period."""
        median = self.own.quantile(0.5)
        return {
            "periods": self.periods,
            "missed_periods": self.missed,
            "own_ms_median": 1e3 * median,
            "own_jitter_ms_p99": 1e3 * (self.own.quantile(0.99) - median),
            "own_jitter_ms_largest": 1e3 * (self.own.longest - median),
            "woken_late_ms_p99": 1e3 * self.woken.quantile(0.99),
            "sent_after_deadline_ms_p99": 1e3 * self.late.quantile(0.99),
            "sent_after_deadline_ms_largest": 1e3 * self.late.longest,
            # After a tenth of the time all has been used once.
            "memory_mib_early": self.memory[len(self.memory) // 10],
            "memory_mib_last": self.memory[-1],
            "memory_mib_largest": max(self.memory),
        }


def resident_mib() -> float:
    """Return how much memory this process has, MiB; NaN where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return math.nan
    return pages * os.sysconf("SC_PAGESIZE") / 2**20


def next_deadline(deadline: float, period: float, now: float) -> tuple[float, int]:
    """Return the first deadline after `now` on the grid of a deadline, and how many were missed on the way."""
    following = deadline + period
    if now <= following:
        return following, 0
    missed = math.ceil((now - following) / period)
    return following + missed * period, missed
