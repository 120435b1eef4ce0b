"""Runs a thread on each rank that signals progress to the others, and ends the process when one of them stops.

NCCL's own watchdog does not see collectives inside of a CUDA graph, and a rank that waits for one waits for ever. The
beats go through the run's key-value store, independently of all collectives.
"""

import os
import threading
import time
from contextlib import suppress
from typing import Protocol

from ksim_rl.device import group
from ksim_rl.terminal import show

# Between beats; a rank whose thread is silent for so long is dead or stopped, and the others end within 35 s, two beats
# later at most. One that says to be in the same place for `KSIM_RL_RANK_TIMEOUT_S` hangs: compiling kernels and
# evaluating take less.
BEAT_S = 2.0
SILENT_S = 30.0
HUNG_S = 600.0
FAILED = 3


_place = ["starting"]
took: dict[int, float] = {}
"""Seconds of each rank's last rollout, from its last beat."""


def at(place: str) -> None:
    """Say where this rank is, such as "collecting iteration 12": it hangs if that is the same for too long."""
    _place[0] = place


class Store(Protocol):
    """The used part of `torch.distributed.Store`: keys of this attempt, over a connection of the thread's own."""

    def set(self, key: str, value: str) -> None: ...  # noqa: D102
    def get(self, key: str) -> bytes: ...  # noqa: D102
    def check(self, keys: list[str]) -> bool: ...  # noqa: D102


class Heartbeat:
    """Beats while it is entered. `done` says that this rank may go silent, and `ended` why it failed."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._hung_s = float(os.environ.get("KSIM_RL_RANK_TIMEOUT_S", HUNG_S))
        self._stop = threading.Event()
        self._lock = threading.Lock()
        # A daemon, so that it never keeps the process alive.
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def __enter__(self) -> "Heartbeat":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()

    def done(self) -> None:
        """Tell the others that this rank has finished."""
        self._tell("done", "1")

    def ended(self, error: BaseException) -> None:
        """Tell the others why this rank ended."""
        self._tell("ended", f"{type(error).__name__}: {' '.join(str(error).split())}"[:500])

    def _tell(self, what: str, text: str) -> None:
        with suppress(Exception), self._lock:  # the store may have gone with the rank that kept it
            self._store.set(f"{what}/{group.rank()}", text)

    def _read(self, what: str, rank: int) -> str | None:
        key = f"{what}/{rank}"
        with self._lock:
            # `get` would wait for a key that is not there.
            if self._store.check([key]):
                return self._store.get(key).decode()
            return None

    def _run(self) -> None:
        others = set(range(group.size())) - {group.rank()}
        # By rank its last beat and its last place, each with this host's time of the change: clocks of
        # different machines are never compared.
        seen: dict[int, tuple[str, float]] = {}
        moved: dict[int, tuple[str, float]] = {}
        count = 0
        while not self._stop.wait(BEAT_S):
            count += 1
            try:
                self._tell("beat", f"{count}|{_place[0]}|{took.get(group.rank(), 0.0)}")
                for rank in sorted(others):
                    # A rank that has finished may be silent for ever.
                    if self._read("done", rank) is not None:
                        others.discard(rank)
                        continue
                    if (why := self._read("ended", rank)) is not None:
                        self._give_up(f"rank {rank} has ended: {why}")
                    beat = self._read("beat", rank) or "0|starting|0"
                    _, place, seconds = beat.split("|")
                    took[rank] = float(seconds)
                    now = time.monotonic()
                    # A new count: the thread of that rank is alive.
                    if rank not in seen or seen[rank][0] != beat:
                        seen[rank] = beat, now
                    # A new place: its main thread moves, too.
                    if rank not in moved or moved[rank][0] != place:
                        moved[rank] = place, now
                    if now - seen[rank][1] > SILENT_S:
                        self._give_up(
                            f"rank {rank} is silent since {SILENT_S:.0f} s ({place}): killed, or stopped"
                        )
                    if now - moved[rank][1] > self._hung_s:
                        self._give_up(f"rank {rank} hangs: {place} since {self._hung_s:.0f} s")
            except Exception as error:
                if not self._stop.is_set():
                    reason = " ".join(str(error).split())
                    self._give_up(
                        f"the store of the run is gone, and with it its rank or torchrun: {reason}"
                    )

    def _give_up(self, why: str) -> None:
        """End this process immediately: its main thread may wait in a collective that nothing can interrupt."""
        if self._stop.is_set():
            return
        self._tell("ended", why)
        show(
            f"ksim-rl: rank {group.rank()}: error: {why}; this rank ends too (it was {_place[0]})",
            to_stderr=True,
        )
        # Not `sys.exit`, which ends this thread only.
        os._exit(FAILED)
