"""Where memory does not suffice, the message says what an env takes and how many fit."""

import weakref

import mujoco_warp as mjw
import pytest
import torch

from ksim_rl import conf
from ksim_rl.device import memory
from ksim_rl.device.memory import memory_for, refused_bytes
from ksim_rl.trainers import RunProgress, run_folder
from tests.cli.payloads import SMALL
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
    said = r"num_envs=1000: .* 16,000,000 bytes of 10\.0 GB .*: at most 625 fit"
    with pytest.raises(ValueError, match=said), memory_for(1000, CUDA):
        raise RuntimeError("Failed to allocate 10000000000 bytes on device 'cuda:0'")


def test_half_as_many_are_tried_until_memory_is_left(monkeypatch):
    def work(num_envs):
        """Take a byte of 100 for each env; 40 are no number that divides the data."""
        if num_envs == 40:
            raise ValueError("40 envs do not divide the data")
        if num_envs > 100:
            raise torch.OutOfMemoryError(f"CUDA out of memory. Tried to allocate {num_envs}.00 KiB")
        tried.append(num_envs)
        return Held(num_envs)

    class Held:
        def __init__(self, num_envs):
            free.append(100 - num_envs)

        def __del__(self):
            free.pop()

    free, tried = [100], []
    monkeypatch.setattr(memory, "_free_bytes", lambda device: free[-1])
    failed = weakref.WeakSet()

    def big():
        array = torch.zeros(3)
        failed.add(array)
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 1.00 KiB")

    def looked(num_envs):
        assert not failed  # what the block had built is gone before anything is tried
        return work(num_envs)

    # 160 do not fit, 80 do and leave 20 %; with 380, 190 do not fit, and 95 leave 5 %, so 47 it is.
    for asked, fits in ((320, 80), (380, 47), (80, 20)):
        said = rf"num_envs={asked}: .*; num_envs={fits} was tried and fits\."
        with pytest.raises(ValueError, match=said), memory_for(asked, CUDA, looked):
            big()
    assert tried == [80, 95, 47, 20]


def test_where_nothing_fits_no_number_is_named(monkeypatch):
    def work(num_envs):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 1.00 GiB")

    monkeypatch.setattr(memory, "_free_bytes", lambda device: 2**20)
    with pytest.raises(ValueError, match=r"num_envs=8: out of memory") as told, memory_for(8, CUDA, work):
        work(8)
    assert "was tried" not in str(told.value)


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


def test_a_run_whose_envs_do_not_fit_names_a_number_that_it_trained(tmp_path, monkeypatch):
    """A machine that holds four envs is asked for 8."""
    build = run_folder.build

    def build_where_four_fit(cfg, **options):
        trainer = build(cfg, **options)
        if cfg.num_envs > 4:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 1.00 GiB")
        built.append(cfg.num_envs)
        return trainer

    built, said = [], []
    monkeypatch.setattr(run_folder, "build", build_where_four_fit)
    progress = RunProgress(1, enabled=False)
    monkeypatch.setattr(progress, "note", said.append)
    cfg = conf.compose(
        [*SMALL, "num_envs=8", "data.num_env_states_per_minibatch=16", "trainer.eval_episodes=0"]
    )
    with pytest.raises(
        ValueError, match=r"num_envs=8: out of memory .* bytes; num_envs=4 was tried and fits"
    ):
        run_folder.run(cfg, tmp_path / "run", progress=progress)
    assert built == [4] and said[-1] == "memory does not suffice: trying num_envs=4"
