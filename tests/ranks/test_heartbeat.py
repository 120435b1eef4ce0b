"""A rank that is dead, stopped or in the same place for too long ends the others, with a cause."""

import threading

import pytest

from ksim_rl.device import group
from ksim_rl.ranks import heartbeat


class Values(dict):
    """A store of one process."""

    def check(self, keys):
        return all(key in self for key in keys)

    def set(self, key, value):
        self[key] = value

    def get(self, key):
        return self[key].encode()


class Ended(BaseException):
    """Stands for the end of the process."""


@pytest.fixture
def ended(monkeypatch):
    """Let rank 0 of 2 beat quickly, and return how to learn of its end."""
    happened = threading.Event()

    def leave(code):
        assert code == heartbeat.FAILED
        happened.set()
        raise Ended

    monkeypatch.setattr(group, "size", lambda: 2)
    monkeypatch.setattr(group, "rank", lambda: 0)
    monkeypatch.setattr(heartbeat, "BEAT_S", 0.01)
    monkeypatch.setattr(heartbeat.os, "_exit", leave)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    return happened


def key(what):
    return f"{what}/1"


def test_a_rank_that_is_silent_ends_the_others(ended, monkeypatch, capsys):
    monkeypatch.setattr(heartbeat, "SILENT_S", 0.1)
    with heartbeat.Heartbeat(Values({key("beat"): "7|in iteration 3|0.5"})):
        assert ended.wait(20)
    assert (
        "rank 1 is silent since 0 s (in iteration 3): killed, or stopped" in capsys.readouterr().err
    )
    assert heartbeat.took[1] == 0.5


def test_a_rank_that_beats_but_does_not_move_hangs(ended, monkeypatch, capsys):
    monkeypatch.setenv("KSIM_RL_RANK_TIMEOUT_S", "0.2")

    class Beating(Values):
        def get(self, name):
            self.count = getattr(self, "count", 0) + 1
            return f"{self.count}|in iteration 4|0.5".encode()

    with heartbeat.Heartbeat(Beating({key("beat"): ""})):
        assert ended.wait(20)
    assert "rank 1 hangs: in iteration 4 since 0 s" in capsys.readouterr().err


def test_the_cause_of_another_rank_is_said(ended, capsys):
    with heartbeat.Heartbeat(Values({key("ended"): "ValueError: num_envs=0"})):
        assert ended.wait(20)
    assert "rank 1 has ended: ValueError: num_envs=0; this rank ends too" in capsys.readouterr().err


def test_a_rank_that_has_finished_may_be_silent(ended, monkeypatch):
    monkeypatch.setattr(heartbeat, "SILENT_S", 0.05)
    with heartbeat.Heartbeat(Values({key("done"): "1", key("beat"): "7|at the end|0"})):
        assert not ended.wait(0.5)
