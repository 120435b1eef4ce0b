"""Times work on a device: CUDA events there, a clock on the CPU."""

import statistics
import time
from collections.abc import Callable

import torch


def milliseconds(
    work: Callable[[], object],
    *,
    device: torch.device,
    repeats: int,
    before: Callable[[], object] | None = None,
) -> float:
    """Return the median time of `work`, ms.

    Args:
        work: what is timed; it must be warm.
        device: where it runs; on CUDA the time is the device's, between two events.
        repeats: how often it is timed.
        before: runs before each, untimed.
    """
    times = []
    for _ in range(repeats):
        if before is not None:
            before()
        if device.type == "cuda":
            start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            torch.cuda.synchronize(device)
            start.record()
            work()
            end.record()
            torch.cuda.synchronize(device)
            times.append(start.elapsed_time(end))
        else:
            began = time.perf_counter()
            work()
            times.append(1000.0 * (time.perf_counter() - began))
    return statistics.median(times)
