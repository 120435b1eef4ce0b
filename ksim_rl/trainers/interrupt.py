"""Turns SIGINT and SIGTERM into a request: the loop ends after the current iteration, with everything saved."""

import os
import signal
import threading
from types import FrameType


class InterruptRequest:
    """While entered, the first signal is remembered instead of raised; a second one interrupts immediately.

    `said` is printed at the first one. Outside the main thread, where Python allows no handlers, nothing is installed.
    """

    def __init__(
        self, said: str = "the run ends after this iteration; once more ends it at once"
    ) -> None:
        self._said = said
        self.signal: signal.Signals | None = None
        self._previous: dict[signal.Signals, object] = {}

    def __bool__(self) -> bool:
        return self.signal is not None

    def __enter__(self) -> "InterruptRequest":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        # Back to the earlier handlers, which may belong to an outer request.
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._previous.clear()

    def _remember(self, number: int, _frame: FrameType | None) -> None:
        if self.signal is not None:
            # The user asks again: no more waiting for the end of the iteration.
            raise KeyboardInterrupt(number)
        self.signal = signal.Signals(number)
        # Not through sys.stderr, which the signal may have found in the middle of a line.
        os.write(2, f"ksim-rl: {self.signal.name}: {self._said}\n".encode())
