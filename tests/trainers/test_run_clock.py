"""The clock of a run, on a time of our own."""

import time

import pytest

from ksim_rl.trainers.progress import RunClock


@pytest.fixture
def now(monkeypatch):
    now = {"s": 100.0}
    monkeypatch.setattr(time, "monotonic", lambda: now["s"])
    return now


def test_laps_add_up_and_the_first_does_not_predict(now):
    clock = RunClock()
    now["s"] += 30.0  # compilation
    assert clock.lap() == 30.0
    assert clock.seconds_left(10) is None
    now["s"] += 2.0
    assert clock.lap() == 2.0
    assert clock.seconds_left(10) == 20.0
    assert clock.total == 32.0


def test_pauses_count_in_the_total_only(now):
    clock = RunClock()
    now["s"] += 1.0
    clock.lap()
    with clock.paused():
        now["s"] += 50.0
    now["s"] += 1.0
    assert clock.lap() == 1.0
    assert clock.total == 52.0
