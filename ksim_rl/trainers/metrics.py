"""Metrics on their way from the device to the host: one copy per iteration, however many there are."""

from collections.abc import Mapping

import torch
from torch import Tensor


class PendingMetrics:
    """Metrics whose copy to the host may still be under way."""

    def __init__(self, names: tuple[str, ...], values: Tensor, copied: "torch.cuda.Event | None") -> None:
        self._names, self._values, self._copied = names, values, copied

    def read(self) -> dict[str, float]:
        """Wait for the copy, and return the metrics by name."""
        if self._copied is not None:
            self._copied.synchronize()
        return dict(zip(self._names, self._values.tolist(), strict=True))


def start_copy(metrics: Mapping[str, Tensor], *, device: torch.device) -> PendingMetrics:
    """Begin to copy 0-dim tensors to the host, as one vector.

    On CUDA the copy goes to pinned memory and does not wait for the device: work that is queued after it may start
    before the host reads.
    """
    names = tuple(metrics)
    if not names:
        return PendingMetrics(names, torch.zeros(0, dtype=torch.float64), None)
    # float64 holds every count of env states exactly.
    values = torch.stack([value.detach().to(torch.float64).reshape(()) for value in metrics.values()])
    if device.type != "cuda":
        return PendingMetrics(names, values, None)
    on_host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
    on_host.copy_(values, non_blocking=True)
    copied = torch.cuda.Event()
    copied.record(torch.cuda.current_stream(device))
    return PendingMetrics(names, on_host, copied)
