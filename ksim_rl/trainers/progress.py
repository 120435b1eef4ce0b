"""Times the progress of a run, and shows it as one live panel on a terminal or as plain lines in a pipe."""

import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress

from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from ksim_rl import ranks
from ksim_rl.terminal import printable

# The figures that are shown, in this order, where the run has them: metric, label, format.
SHOWN = (
    ("env_states", "env states", "{:,.0f}"),
    ("throughput/env_states_per_s", "env states/s", "{:,.0f}"),
    ("throughput/slowest_rank", "slowest rank", "{:.0f}"),
    ("episode/return", "return", "{:.3g}"),
    ("episode/length", "episode length", "{:.4g}"),
    ("loss/policy", "policy loss", "{:.2g}"),
    ("loss/value", "value loss", "{:.2g}"),
    ("loss/entropy", "entropy", "{:.3g}"),
    ("style/reward", "style", "{:.2f}"),
    ("update/action_error", "action error", "{:.3g}"),
    ("update/learning_rate", "learning rate", "{:.1e}"),
    ("evaluation/return_mean", "evaluation", "{:.4g}"),
)

# In a pipe, nothing is silent for longer: who reads it would take a long silence for a hang.
SILENCE_S = 15.0


class _OwnConsole(Console):
    """A console that goes silent when its pipe is closed; rich's own console would end the process."""

    def on_broken_pipe(self) -> None:
        try:
            super().on_broken_pipe()
        except SystemExit:
            with suppress(OSError):  # stderr may be the same pipe
                print("ksim-rl: the output is no longer read; the run goes on", file=sys.stderr)


class RunProgress:
    """Shows iteration, speed, return, episode length, losses and the time left.

    Use as a context manager around the run. `note` prints a line that stays; `status` shows what is going on while
    nothing else moves (kernel compilation), and `busy` does so for a block, in which a pipe gets a line every
    `SILENCE_S`. Of the `total` iterations of the whole run, `done` are already done;
    without `enabled` only notes are shown.
    """

    def __init__(
        self, total: int, *, done: int = 0, console: Console | None = None, enabled: bool = True
    ) -> None:
        self.total = total
        self.done = done
        self.console = console or _OwnConsole(highlight=False)
        # Other ranks show nothing, as all ranks are at the same iteration.
        self._enabled = enabled and ranks.rank() == 0
        self._status = ""
        self._metrics: dict[str, float] = {}
        self._live: Live | None = None
        self._doing = ""
        self._since = 0.0
        self._moved = 0.0
        self._spoken = time.monotonic()
        self._watched = False
        self._open = ExitStack()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left {task.fields[left]}"),
            console=self.console,
            expand=True,
        )
        self._task: TaskID = self._bar.add_task("iteration", total=total, completed=done, left="?")

    def __enter__(self) -> "RunProgress":
        if self._enabled and self.console.is_terminal:
            self._live = Live(self._panel(), console=self.console, refresh_per_second=4)
            self._live.start()
        # For the whole run: in a pipe this starts the thread that breaks the silence.
        self._open.enter_context(self.busy(""))
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
        if self._live is not None:
            self._live.update(self._panel(), refresh=True)
            self._live.stop()
            self._live = None

    def update(
        self, iteration: int, metrics: Mapping[str, float], *, seconds_left: float | None
    ) -> None:
        """Show the state after `iteration`."""
        self.done = iteration
        self._moved = time.monotonic()
        # Metrics of evaluations stay in the panel between evaluations.
        self._metrics |= metrics
        self._status = ""
        if seconds_left is None:
            left = "?"
        else:
            left = clock(seconds_left)
        self._bar.update(self._task, completed=iteration, left=left)
        if self._live is not None:
            self._live.update(self._panel())
        elif self._enabled:
            shown = ", ".join(f"{label} {text}" for label, text in self._figures(metrics))
            self.note(f"iteration {iteration}/{self.total}: {shown}, left {left}")

    def note(self, text: str) -> None:
        """Print one line that stays; of several ranks only rank 0 prints, except for reports of the NaN guard."""
        if ranks.rank() and not text.startswith("NaN guard"):
            return
        self._spoken = time.monotonic()
        self.console.print(printable(text), markup=False, soft_wrap=True)

    def status(self, text: str) -> None:
        """Show the present activity; in a pipe, texts that begin alike are printed once."""
        beginning = text.split(":")[0]
        if self._live is not None:
            self._status = text
            self._live.update(self._panel(), refresh=True)
        elif beginning != self._status:
            self._status = beginning
            self.note(text)

    @contextmanager
    def busy(self, text: str) -> Iterator[None]:
        """Show the activity of a block that takes long; without a text, that iterations go on."""
        before = self._doing, self._since
        self._doing = text
        self._since = time.monotonic()
        with ExitStack() as shown:
            # A running panel shows the text; before it a spinner does; in a pipe a thread prints lines.
            if self._live is not None and text:
                self.status(text)
                shown.callback(self.status, "")
            elif self._enabled and self.console.is_terminal and text:
                shown.enter_context(self.console.status(Text(printable(text))))
            elif self._enabled and not self.console.is_terminal and not self._watched:
                shown.enter_context(self._watch())
            yield
        self._doing, self._since = before

    @contextmanager
    def _watch(self) -> Iterator[None]:
        """Break the silence of a pipe."""
        # One thread for the outermost block; inner blocks only change what it says.
        done = threading.Event()
        self._watched = True

        def speak() -> None:
            # Looks every second, so that a line is late by a second at most.
            while not done.wait(SILENCE_S / 15.0):
                now = time.monotonic()
                if now - self._spoken >= SILENCE_S:
                    text = self._doing or f"iteration {self.done + 1}/{self.total}"
                    if self._doing:
                        since = self._since
                    else:
                        since = max(self._since, self._moved)
                    self.note(f"{text}: {now - since:.0f} s so far")

        watcher = threading.Thread(target=speak, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()
            self._watched = False

    def _figures(self, metrics: Mapping[str, float]) -> list[tuple[str, str]]:
        return [
            (label, pattern.format(metrics[name]))
            for name, label, pattern in SHOWN
            if name in metrics
        ]

    def _panel(self) -> Group:
        figures = self._figures(self._metrics)
        table = Table.grid(padding=(0, 2))
        # Three columns keep the panel a few lines high.
        for start in range(0, len(figures), 3):
            table.add_row(
                *(f"[dim]{label}[/dim] {text}" for label, text in figures[start : start + 3])
            )
        return Group(self._bar, table, *([Text(printable(self._status))] if self._status else []))


class RunClock:
    """Measures iterations; evaluations and checkpoints count in the total, not in an iteration."""

    def __init__(self) -> None:
        self.total = 0.0  # s, over all sessions of a resumed run
        self._last: float | None = None
        self._laps: deque[float] = deque(maxlen=20)
        self._created = time.monotonic()

    def begin(self) -> None:
        """Begin the first iteration now."""
        self._created = time.monotonic()
        self._last = None

    def lap(self) -> float:
        """End an iteration, and return its seconds."""
        now = time.monotonic()
        # Not zero, as throughput divides by it.
        seconds = max(now - (self._created if self._last is None else self._last), 1e-9)
        # The first iteration compiles kernels, so it says nothing about the rest.
        if self._last is not None:
            self._laps.append(seconds)
        self.total += seconds
        self._last = now
        return seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Count the time of this block in the total, but not in the iteration."""
        start = time.monotonic()
        yield
        elapsed = time.monotonic() - start
        self.total += elapsed
        if self._last is not None:
            # Moves the start of the present iteration forward by the pause.
            self._last += elapsed

    def seconds_left(self, iterations: int) -> float | None:
        """Estimate the time for so many more iterations from the latest ones; None before the second."""
        if not self._laps:
            return None
        return iterations * sum(self._laps) / len(self._laps)


def clock(seconds: float) -> str:
    """Write a duration as h:mm:ss or m:ss."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minute:02d}:{second:02d}"
    return f"{minute}:{second:02d}"
