"""A task that crashes or hangs ends alone."""

import os
import time

import pytest

from benchmarks.judge.workers import in_processes


def do(task: str) -> str:
    if task == "crash":
        os._exit(7)
    if task == "hang":
        time.sleep(1000.0)
    if task.startswith("which"):
        return str(os.getpid())
    return task.upper()


@pytest.mark.full
def test_others_go_on():
    tasks = ["a", "crash", "b", "hang", "c"]
    found = dict(in_processes(do, tasks, jobs=2, most_seconds=8.0))
    assert [found[name] for name in "abc"] == ["A", "B", "C"]
    assert "ended with code 7" in str(found["crash"])
    assert "took too long" in str(found["hang"])


def test_no_task_begins_too_late():
    assert (
        list(in_processes(do, ["a"], jobs=1, most_seconds=8.0, until=time.monotonic() - 1.0)) == []
    )


def test_a_process_that_is_spoilt_does_nothing_further():
    same = list(in_processes(do, ["which 1", "which 2"], jobs=1, most_seconds=60.0))
    assert same[0][1] == same[1][1]
    others = list(
        in_processes(do, ["which 1", "which 2"], jobs=1, most_seconds=60.0, spoils=str.isdigit)
    )
    assert others[0][1] != others[1][1]


@pytest.mark.full
def test_what_runs_too_long_after_the_end_is_given_up():
    begun = time.monotonic()
    tasks = ["a", "hang"]
    found = list(in_processes(do, tasks, jobs=2, most_seconds=900.0, until=begun + 10.0, grace=1.0))
    assert [task for task, _ in found] == ["a"]
