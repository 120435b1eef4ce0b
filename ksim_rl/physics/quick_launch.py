"""Warp launches that cost little from Python.

`wp.launch` packs every argument anew, which takes longer than most small kernels run. Warp can record a launch and issue
it again; then only the numbers are written into memory that is packed already.
"""

import threading
from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from ksim_rl.physics.streams import CPU_LOCK, warp_scope, warp_stream

MAX_RECORDED = 64
"""Records that one kernel keeps, one per device and size; a batch size that never comes again must not pile up."""


class QuickLaunch:
    """One Warp kernel, all of whose arguments are numbers and addresses (`wp.uint64`), launched on torch's stream.

    Args:
        kernel: without gradients.
    """

    def __init__(self, kernel: wp.Kernel) -> None:
        self._kernel = kernel
        self._recorded: dict[tuple[torch.device, tuple[int, ...]], wp.Launch] = {}
        # Arguments lie in memory that all launches share until the driver, or the kernel on the CPU, has read them.
        self._lock = threading.Lock()

    def __call__(self, device: torch.device, dim: tuple[int, ...], values: Sequence[float]) -> None:
        """Launch on `device` with one value per argument; nothing for a dim of 0."""
        if 0 in dim:
            return
        is_cpu = device.type == "cpu"
        with CPU_LOCK if is_cpu else self._lock:
            launch = self._recorded.get((device, dim)) or self._record(device, dim, values)
            # The first parameter is the launch's size.
            for parameter, value in zip(launch.params[1:], values, strict=True):
                parameter.value = value
            launch.launch(None if is_cpu else warp_stream(torch.cuda.current_stream(device)))

    def _record(self, device: torch.device, dim: tuple[int, ...], values: Sequence[float]) -> wp.Launch:
        if len(self._recorded) >= MAX_RECORDED:
            self._recorded.clear()
        with warp_scope(device):
            launch = wp.launch(self._kernel, dim, inputs=values, device=str(device), record_cmd=True)
        self._recorded[device, dim] = launch
        return launch


def address(tensor: Tensor | None) -> int:
    """Return where a tensor lies; 0 for None."""
    return 0 if tensor is None else tensor.data_ptr()
