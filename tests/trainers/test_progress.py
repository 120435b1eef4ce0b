"""Progress: plain lines in a pipe, one panel on a terminal."""

import io
import subprocess
import sys
import time

import pytest
from rich.console import Console

from ksim_rl.trainers import progress as progress_module
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


# A pipe without a reader, as `ksim-rl train | head` leaves it.
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


@pytest.mark.full
def test_a_pipe_that_nobody_reads_does_not_end_the_run():
    done = subprocess.run([sys.executable, "-c", CLOSED], stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr.count("the output is no longer read")) == (0, 1)


def lines_within(progress, count):
    """Wait for so many lines, and return what was printed."""
    for _ in range(500):
        if progress.console.file.getvalue().count("\n") >= count:
            break
        time.sleep(0.01)
    return progress.console.file.getvalue().splitlines()


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(progress_module, "SILENCE_S", 0.05)


def test_a_pipe_is_never_silent_for_long(impatient):
    progress = piped()
    with progress:
        assert lines_within(progress, 2)[0] == "iteration 1/10: 0 s so far"
        with progress.busy("evaluating over 100 episodes"):
            before = len(progress.console.file.getvalue().splitlines())
            assert (
                lines_within(progress, before + 2)[-1] == "evaluating over 100 episodes: 0 s so far"
            )
        progress.update(3, METRICS, seconds_left=None)
        told = len(progress.console.file.getvalue().splitlines())
        assert lines_within(progress, told + 1)[-1] == "iteration 4/10: 0 s so far"
    said = progress.console.file.getvalue()
    time.sleep(0.2)
    assert progress.console.file.getvalue() == said, "nothing is said once the run is over"


def test_a_command_that_is_no_run_speaks_too(impatient):
    progress = piped()
    with progress.busy("analysing"):
        assert lines_within(progress, 1)[0] == "analysing: 0 s so far"


def test_what_is_said_otherwise_is_enough():
    progress = piped()
    with progress, progress.busy("evaluating"):
        time.sleep(0.05)
    assert progress.console.file.getvalue() == ""


def test_a_terminal_shows_what_goes_on():
    console = Console(file=io.StringIO(), force_terminal=True, width=100, highlight=False)
    progress = RunProgress(10, console=console)
    with progress.busy("analysing"):
        pass
    assert "analysing" in console.file.getvalue()
    with progress, progress.busy("evaluating"):
        pass
    assert "evaluating" in console.file.getvalue()
