import gc

import pytest
import torch

from ksim_rl.device import capture
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
