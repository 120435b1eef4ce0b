"""A kernel in C++ on Warp, and its launches, which are recorded once and issued again."""

import ctypes
import struct
import threading
from collections.abc import Mapping
from typing import Any

import torch
import warp as wp

from ksim_rl.device import upstream
from ksim_rl.device.streams import CPU_LOCK, current_warp_stream, warp_scope

MAX_RECORDED = 64
"""Records that one kernel keeps, one per device and size; a batch size that never comes again must not pile up."""


class NativeKernel:
    """A kernel whose only argument, `a`, is a struct; see `QuickLaunch`, which makes one at its first launch.

    `fields` has the struct's types by name, in order. `loadable` is the module that Warp compiles, with the size of its
    blocks.
    """

    def __init__(
        self,
        fields: Mapping[str, type | str],
        source: str,
        indices: tuple[str, str],
        *,
        preamble: str,
        block_dim: int,
    ) -> None:
        types = {name: _type_of(kind) for name, kind in fields.items()}
        arguments: Any = wp.struct(type("Arguments", (), {"__annotations__": types}))

        # The C++ sees the thread's place under the names that its author chose.
        @wp.func_native(f"const int {indices[0]} = index_0, {indices[1]} = index_1;\n{source}")
        def run(index_0: int, index_1: int, a: arguments): ...  # type: ignore[valid-type]

        @wp.kernel(
            module="unique",
            enable_backward=False,
            grid_stride=False,
            module_options={"extra_build_options": upstream.with_preamble(preamble)},
        )
        def kernel(a: arguments):  # type: ignore[valid-type]
            index_0, index_1 = wp.tid()
            run(index_0, index_1, a)

        self._kernel = kernel
        self._arguments = arguments
        self._block_dim = block_dim
        self.loadable: tuple[wp.Module, int] = kernel.module, block_dim
        self._recorded: dict[
            tuple[torch.device, tuple[int, int]], tuple[wp.Launch, ctypes.Structure]
        ] = {}
        self._packer = struct.Struct("")
        # The bytes are shared by all launches until the driver, or the kernel on the CPU, has read them.
        self._lock = threading.Lock()

    def launch(self, device: torch.device, dim: tuple[int, int], values: tuple[float, ...]) -> None:
        """Launch with one value per field, in their order."""
        if device.type == "cpu":
            lock = CPU_LOCK
            stream = None
        else:
            lock = self._lock
            stream = current_warp_stream(device)
        with lock:
            # The first launch of a device and size is recorded; the others write their bytes into that record.
            launch, packed = self._recorded.get((device, dim)) or self._record(device, dim)
            self._packer.pack_into(packed, 0, *values)
            launch.launch(stream)

    def _record(
        self, device: torch.device, dim: tuple[int, int]
    ) -> tuple[wp.Launch, ctypes.Structure]:
        # Sizes that come only once, such as a last batch, would pile up.
        if len(self._recorded) >= MAX_RECORDED:
            self._recorded.clear()
        # Recorded without running: the arguments are still empty.
        with warp_scope(device):
            launch = wp.launch(
                self._kernel,
                dim,
                inputs=[self._arguments()],
                device=str(device),
                record_cmd=True,
                block_dim=self._block_dim,
            )
        packed: Any = upstream.recorded_arguments(launch)
        # The layout of the struct's bytes, with C's alignment.
        self._packer = struct.Struct("@" + "".join(kind._type_ for _, kind in packed._fields_))
        self._recorded[device, dim] = launch, packed
        return launch, packed


def _type_of(kind: type | str) -> Any:
    if isinstance(kind, str):
        return vars(wp)[kind]
    return kind
