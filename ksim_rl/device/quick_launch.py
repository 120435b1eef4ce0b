"""Launches Warp kernels at little cost from Python.

`wp.launch` packs every argument anew, which takes longer than most small kernels run. Warp can record a launch and
issue it again; then only the bytes of its arguments are written, in one go.
"""

import ctypes
import struct
import threading
from collections.abc import Callable, Sequence
from importlib.resources import files
from inspect import signature
from typing import Any, ClassVar
from weakref import WeakSet

import torch
import warp as wp
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.device import recording, upstream
from ksim_rl.device.streams import CPU_LOCK, current_warp_stream, warp_scope

MAX_RECORDED = 64
"""Records that one kernel keeps, one per device and size; a batch size that never comes again must not pile up."""


def arguments_of(*fields: tuple[type, str]) -> Any:
    """Return the struct of a `QuickLaunch` with these fields in order: types, each with names and blanks between."""
    types = {name: kind for kind, names in fields for name in names.split()}
    return wp.struct(type("Arguments", (), {"__annotations__": types}))


def source_of(package: str, *parts: str) -> str:
    """Return the C++ of a kernel, whose parts lie in files of a package."""
    return "".join((files(package) / f"{part}.cpp").read_text() for part in parts)


class QuickLaunch:
    """One kernel in C++ whose only argument, `a`, is a struct of numbers and addresses, launched on torch's stream.

    Addresses are `wp.uint64`, as wrapping a tensor takes longer than the launch. The source runs for each pair of
    `indices` within the launch's dim. The kernel has no gradients.
    """

    existing: ClassVar[WeakSet["QuickLaunch"]] = WeakSet()

    def __init__(
        self,
        arguments: type,
        source: str,
        indices: tuple[str, str] = ("row", "lane"),
        *,
        block_dim: int = 256,
    ) -> None:
        @wp.func_native(f"const int {indices[0]} = index_0, {indices[1]} = index_1;\n{source}")
        def run(index_0: int, index_1: int, a: arguments): ...  # type: ignore[valid-type]

        @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
        def kernel(a: arguments):  # type: ignore[valid-type]
            index_0, index_1 = wp.tid()
            run(index_0, index_1, a)

        self._kernel = kernel
        self._arguments = arguments
        self._block_dim = block_dim
        self.loadable: tuple[wp.Module, int] = kernel.module, block_dim  # what is compiled, for which blocks
        self._recorded: dict[tuple[torch.device, tuple[int, int]], tuple[wp.Launch, ctypes.Structure]] = {}
        self._packer = struct.Struct("")
        # The bytes are shared by all launches until the driver, or the kernel on the CPU, has read them.
        self._lock = threading.Lock()
        QuickLaunch.existing = WeakSet([*QuickLaunch.existing, self])  # a thread may go through the old one

    def __call__(self, device: torch.device, dim: tuple[int, int], *values: float) -> None:
        """Launch with one value per field of the struct, in their order; do nothing for a dim of 0."""
        if 0 in dim:
            return
        assert not recording.is_recording(), "a kernel that is no operator of torch cannot be recorded"
        if device.type == "cpu":
            lock = CPU_LOCK
            stream = None
        else:
            lock = self._lock
            stream = current_warp_stream(device)
        with lock:
            launch, packed = self._recorded.get((device, dim)) or self._record(device, dim)
            self._packer.pack_into(packed, 0, *values)
            launch.launch(stream)

    def _record(self, device: torch.device, dim: tuple[int, int]) -> tuple[wp.Launch, ctypes.Structure]:
        if len(self._recorded) >= MAX_RECORDED:
            self._recorded.clear()
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
        self._packer = struct.Struct("@" + "".join(kind._type_ for _, kind in packed._fields_))
        self._recorded[device, dim] = launch, packed
        return launch, packed


def as_operator(
    name: str, launch: Callable[..., Any], fake: Callable[..., Any], *, mutates: Sequence[str] = ()
) -> Callable[..., Any]:
    """Return `launch` as a function that is a torch operator where code is traced.

    Eager code goes past torch's dispatcher, which takes longer than the launch. `fake` returns an empty result for the
    arguments, of which those named in `mutates` are changed.
    """
    # torch 2.11 looks for each of these among the arguments that were given, without those that equal their defaults.
    defaults = {name for name, own in signature(launch).parameters.items() if own.default is not own.empty}
    assert not defaults & set(mutates), f"{name}: arguments that are changed have no default"
    operator = torch.library.custom_op(f"ksim_rl::{name}", launch, mutates_args=mutates)
    operator.register_fake(fake)

    def run(*arguments: object) -> Any:
        is_traced = torch.compiler.is_compiling() or recording.is_recording()
        return (operator if is_traced else launch)(*arguments)

    return run


def address(tensor: Shaped[Tensor, "*shape"] | None) -> int:
    """Return where a tensor lies; 0 for None."""
    return 0 if tensor is None else tensor.data_ptr()
