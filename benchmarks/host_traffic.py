"""Counts the waits and copies of one iteration between host and GPU, as CUDA's profiler saw them."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile, record_function

# Calls that wait for all work of a stream or the device. An event is waited for only where a copy is read.
SYNCS = (
    "cudaStreamSynchronize",
    "cudaDeviceSynchronize",
    "cuStreamSynchronize",
    "cuCtxSynchronize",
)
BLOCKING_COPIES = ("cudaMemcpy", "cuMemcpyDtoH_v2")

WORK = "work"

Event = dict[str, Any]


def cuda_events(work: Callable[[], object]) -> list[Event]:
    """Run `work` under the profiler and return its events, as a Chrome trace has them."""
    torch.cuda.synchronize()
    with (
        profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as recorded,
        record_function(WORK),
    ):
        work()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        recorded.export_chrome_trace(str(path))
        return json.loads(path.read_text())["traceEvents"]


def host_traffic(work: Callable[[], object]) -> dict[str, int]:
    """Return how often `work` waits for the device, and how many copies it takes to the host."""
    events = cuda_events(work)
    work_event = next(
        event
        for event in events
        if event.get("name") == WORK and event.get("cat") == "user_annotation"
    )
    end = work_event["ts"] + work_event["dur"]
    # Leaving the profiler waits for the device as well, after the end.
    calls = [
        event["name"]
        for event in events
        if event.get("cat") in ("cuda_runtime", "cuda_driver") and event["ts"] < end
    ]
    waits = sum(name in SYNCS or name in BLOCKING_COPIES for name in calls)
    copies = sum(event.get("cat") == "gpu_memcpy" and "DtoH" in event["name"] for event in events)
    return {"host_syncs": waits, "host_copies": copies}
