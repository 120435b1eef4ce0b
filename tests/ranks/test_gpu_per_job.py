"""Jobs of a multirun have a GPU each: no GPU is needed to see which one they would take."""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor

import pytest
import torch
from hydra.types import RunMode
from omegaconf import OmegaConf

from ksim_rl.ranks import gpu_per_job


@pytest.fixture
def gpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(gpu_per_job, "_taken", [])
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")


def taken(sweep, device, mode, barrier):
    hydra = {"mode": RunMode[mode], "sweep": {"dir": str(sweep)}}
    for _ in range(2):  # the second job of a process has what the first one had
        gpu_per_job.GpuPerJob().on_job_start(OmegaConf.create({"device": device, "hydra": hydra}))
    barrier.wait(60)
    return os.environ["CUDA_VISIBLE_DEVICES"]


def of_processes(count, *arguments):
    """Return what processes see that run jobs at the same time."""
    context = multiprocessing.get_context("fork")
    with context.Manager() as manager, ProcessPoolExecutor(count, mp_context=context) as pool:
        barrier = manager.Barrier(count)
        return sorted(pool.map(taken, *zip(*[(*arguments, barrier)] * count, strict=True)))


@pytest.mark.usefixtures("gpus")
def test_each_job_at_a_time_has_a_gpu_and_more_jobs_share_them_equally(tmp_path):
    assert of_processes(2, tmp_path / "two", "auto", "MULTIRUN") == ["4", "6"]
    assert of_processes(4, tmp_path / "four", "cuda", "MULTIRUN") == ["4", "4", "6", "6"]
    assert of_processes(2, tmp_path / "two", "auto", "MULTIRUN") == ["4", "6"], (
        "those that ended gave theirs back"
    )


@pytest.mark.usefixtures("gpus")
@pytest.mark.parametrize(
    ("device", "mode"), [("cuda:1", "MULTIRUN"), ("cpu", "MULTIRUN"), ("auto", "RUN")]
)
def test_other_jobs_see_all(device, mode, tmp_path):
    assert of_processes(1, tmp_path, device, mode) == ["4,6"]
