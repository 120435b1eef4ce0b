"""Times each rank's rollouts, which wait for no other rank, so that rank 0 can name the slowest one."""

import time

import torch

from ksim_rl.device.group import rank, size
from ksim_rl.ranks import heartbeat


class Timing:
    """Times blocks, on CUDA by events, whose times are read by `slowest` only when they have passed."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._passed = [0.0]
        self._events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []

    def begin(self, iteration: int) -> None:
        """Begin to collect."""
        if size() == 1:
            return
        # Each iteration is a new place, which shows the others that this rank moves.
        heartbeat.at(f"in iteration {iteration}")
        self._began = time.perf_counter()
        if self._device.type == "cuda":
            events = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            # Events take no time of the host, and do not wait for the device.
            events[0].record(torch.cuda.current_stream(self._device))
            self._events.append(events)

    def end(self) -> None:
        """Stop the time that `begin` began to take."""
        if size() == 1:
            return
        if self._device.type == "cuda":
            self._events[-1][1].record(torch.cuda.current_stream(self._device))
        else:
            self._passed.append(time.perf_counter() - self._began)

    def slowest(self) -> dict[str, float]:
        """Return which rank's last rollout took the longest, and how many seconds; nothing with one rank.

        On CUDA it is called after the work of the iteration is done. Other ranks' times come with their heartbeats.
        """
        if size() == 1:
            return {}
        # Only events that have passed: asking for the others would wait for the device.
        while self._events and self._events[0][1].query():
            begin, end = self._events.pop(0)
            self._passed.append(begin.elapsed_time(end) / 1000.0)
        # Only the last rollout is reported.
        del self._passed[:-1]
        heartbeat.took[rank()] = self._passed[-1]
        slowest = max(heartbeat.took, key=lambda index: heartbeat.took[index])
        return {
            "throughput/slowest_rank": float(slowest),
            "throughput/slowest_rollout_s": heartbeat.took[slowest],
        }
