import gc

import pytest
import torch

from ksim_rl.device import capture
from ksim_rl.device.eager import eagerly, runs_eagerly
from ksim_rl.physics import Captured
from tests.physics.models import standing_quadrupeds


def test_on_cpu_it_is_a_plain_call():
    calls = []
    body = Captured(lambda: calls.append(capture.is_capturing()), device="cpu")
    for _ in range(5):
        body()
    assert calls == [False] * 5
    assert not body.ready


def test_a_call_in_a_live_block_leaves_the_world_bit_identical():
    graphed, live = standing_quadrupeds(), standing_quadrupeds()
    with capture.live_launches():
        for _ in range(3):
            live.step(2)
            live.refresh()
    for _ in range(3):
        graphed.step(2)
        graphed.refresh()
    assert torch.equal(graphed.qpos_EL, live.qpos_EL)
    assert torch.equal(graphed.sensordata_EL, live.sensordata_EL)


def test_what_is_made_in_a_block_of_eager_is_so_for_ever():
    with eagerly():
        assert runs_eagerly()
        eager = Captured(lambda: None, device="cpu")
        with eagerly(False):
            assert runs_eagerly()
    assert eager.is_eager and not Captured(lambda: None, device="cpu").is_eager
    assert not runs_eagerly()


class FakeGraph:
    """Counts replays."""

    def __init__(self):
        self.replays = 0

    def replay(self):
        self.replays += 1


def graphed(monkeypatch, body):
    """Return a `Captured` that records fake graphs, on a machine without CUDA."""
    captured = Captured(body, device="cpu", warmup=2)
    captured._eager_for_ever, captured._stream = False, object()
    monkeypatch.setattr(captured, "_run_eagerly", lambda _stream: body())
    monkeypatch.setattr(captured, "_record", lambda _stream: (body(), (FakeGraph(), None))[1])
    return captured


def test_a_graph_that_is_forgotten_is_recorded_after_one_eager_call(monkeypatch):
    calls = []
    captured = graphed(monkeypatch, lambda: calls.append(1))
    for _ in range(5):
        captured()
    assert captured.ready and len(calls) == 3
    captured.forget()
    assert not captured.ready
    for _ in range(4):
        captured()
    assert captured.ready and len(calls) == 5


def test_while_it_is_eager_the_graph_waits(monkeypatch):
    calls = []
    captured = graphed(monkeypatch, lambda: calls.append(1))
    for _ in range(3):
        captured()
    captured.is_eager = True
    captured()
    captured.is_eager = False
    captured()
    assert len(calls) == 4 and captured._graph.replays == 2


def test_collection_is_paused_and_comes_back():
    assert gc.isenabled()
    with capture.no_collection():
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with capture.no_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_warmup_is_checked():
    with pytest.raises(ValueError, match="warmup=0"):
        Captured(lambda: None, device="cpu", warmup=0)
