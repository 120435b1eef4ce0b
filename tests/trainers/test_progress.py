"""Progress: plain lines in a pipe, one panel on a terminal."""

import io
import subprocess
import sys

import pytest
from rich.console import Console

from ksim_rl.trainers.progress import RunProgress, clock

METRICS = {
    "env_states": 16384.0,
    "throughput/env_states_per_s": 51234.5,
    "episode/return": 12.3,
    "loss/value": 0.5,
}


def piped(**options):
    return RunProgress(10, console=Console(file=io.StringIO(), highlight=False), **options)


def test_a_pipe_gets_one_plain_line_per_update():
    progress = piped()
    with progress:
        progress.update(3, METRICS, seconds_left=75.0)
    text = progress.console.file.getvalue()
    assert text == (
        "iteration 3/10: env states 16,384, env states/s 51,234, return 12.3, value loss 0.5, left 1:15\n"
    )


def test_a_terminal_gets_a_panel_with_the_same_figures_and_the_time_left():
    console = Console(file=io.StringIO(), force_terminal=True, width=100, highlight=False)
    progress = RunProgress(10, console=console)
    with progress:
        progress.update(3, METRICS, seconds_left=75.0)
    text = console.file.getvalue()
    for part in ("iteration", "3/10", "left 1:15", "16,384", "51,234", "12.3"):
        assert part in text


def test_notes_stay_and_are_printed_as_they_are():
    progress = piped()
    with progress:
        progress.note("warning: [bold] is no markup here")
    assert progress.console.file.getvalue() == "warning: [bold] is no markup here\n"


def test_compilation_is_said_once_per_burst_in_a_pipe():
    progress = piped()
    with progress:
        progress.status("compiling Warp kernels (first use): 1 modules, 2 s")
        progress.status("compiling Warp kernels (first use): 2 modules, 4 s")
    assert progress.console.file.getvalue().count("compiling") == 1


def test_compilation_is_shown_in_the_panel():
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    progress = RunProgress(10, console=console)
    with progress:
        progress.status("compiling Warp kernels: 1 modules, 2 s")
    assert "compiling Warp kernels" in console.file.getvalue()


def test_without_progress_only_notes_are_shown():
    progress = piped(enabled=False)
    with progress:
        progress.update(1, METRICS, seconds_left=None)
        progress.note("a note")
    assert progress.console.file.getvalue() == "a note\n"


@pytest.mark.parametrize(("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (3725, "1:02:05")])
def test_durations_are_readable(seconds, text):
    assert clock(seconds) == text


# A pipe that nobody reads, as `ksim-rl train | head` leaves it.
CLOSED = """
import os
reading, writing = os.pipe()
os.dup2(writing, 1)
os.close(reading)
from ksim_rl.trainers.progress import RunProgress
with RunProgress(10) as progress:
    for iteration in range(10):
        progress.update(iteration, {}, seconds_left=None)
"""


def test_a_pipe_that_nobody_reads_does_not_end_the_run():
    done = subprocess.run([sys.executable, "-c", CLOSED], stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr.count("nobody reads the output any more")) == (0, 1)
