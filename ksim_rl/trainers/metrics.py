"""Metrics come from the device to the host in one copy per iteration, however many there are."""

from collections.abc import Mapping

import torch
from jaxtyping import Float64, Shaped
from torch import Tensor


class PendingMetrics:
    """Metrics whose copy to the host may still be under way."""

    def __init__(
        self, names: tuple[str, ...], values_M: Float64[Tensor, " M"], copied: "torch.cuda.Event | None"
    ) -> None:
        self._names, self._values_M, self._copied = names, values_M, copied

    def read(self) -> dict[str, float]:
        """Wait for the copy, and return the metrics by name."""
        if self._copied is not None:
            self._copied.synchronize()
        return dict(zip(self._names, self._values_M.tolist(), strict=True))


def start_copy(metrics: Mapping[str, Shaped[Tensor, ""]], *, device: torch.device) -> PendingMetrics:
    """Begin to copy 0-dim tensors to the host, as one vector.

    On CUDA the copy goes to pinned memory and does not wait for the device: work that is queued after it may start
    before the host reads.
    """
    names = tuple(metrics)
    if not names:
        return PendingMetrics(names, torch.zeros(0, dtype=torch.float64), None)
    # float64 holds every count of env states exactly.
    values_M = torch.stack([value.detach().to(torch.float64).reshape(()) for value in metrics.values()])
    if device.type != "cuda":
        return PendingMetrics(names, values_M, None)
    on_host_M = torch.empty(values_M.shape, dtype=values_M.dtype, pin_memory=True)
    on_host_M.copy_(values_M, non_blocking=True)
    copied = torch.cuda.Event()
    copied.record(torch.cuda.current_stream(device))
    return PendingMetrics(names, on_host_M, copied)
