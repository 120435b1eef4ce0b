"""Where memory does not suffice, the message says what an env takes and how many fit."""

import mujoco_warp as mjw
import pytest
import torch

from ksim_rl.device import memory
from ksim_rl.device.memory import memory_for, refused_bytes
from tests.physics.models import standing_quadrupeds

CPU, CUDA = torch.device("cpu"), torch.device("cuda:0")


def test_refusals_are_told_from_other_errors():
    # A real one: no machine has the memory for it, and nothing of it is touched.
    with pytest.raises(RuntimeError) as refused:
        torch.empty(2**55, dtype=torch.uint8)
    assert refused_bytes(refused.value) == 2**55
    assert refused_bytes(RuntimeError("Failed to allocate 1024 bytes on device 'cuda:0'")) == 1024
    on_cuda = torch.OutOfMemoryError(
        "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity"
    )
    assert refused_bytes(on_cuda) == 5 * 2**29
    assert refused_bytes(RuntimeError("shape mismatch")) is None


def test_the_number_that_fits_follows_from_what_was_taken(monkeypatch):
    free = iter((10_000_000_000, 4_000_000_000))
    monkeypatch.setattr(memory, "_free_bytes", lambda device: next(free))
    # 6 GB were taken when 10 GB more were asked for, for 1000 envs: 16 MB each, of which 10 GB hold 625.
    said = r"num_envs=1000: .* 16,000,000 bytes of the 10\.0 GB .* enough for 625"
    with pytest.raises(ValueError, match=said), memory_for(1000, CUDA):
        raise RuntimeError("Failed to allocate 10000000000 bytes on device 'cuda:0'")


def test_other_errors_pass():
    with pytest.raises(RuntimeError, match="^shape mismatch$"), memory_for(4, CPU):
        raise RuntimeError("shape mismatch")


def test_a_world_that_does_not_fit_says_so(monkeypatch):
    def refuse(*args, **kwargs):
        raise RuntimeError("Failed to allocate 4000 bytes on device 'cpu'")

    monkeypatch.setattr(mjw, "make_data", refuse)
    with pytest.raises(
        ValueError, match=r"num_envs=4: out of memory on cpu; one env takes at least 1,000 bytes"
    ):
        standing_quadrupeds(4)
