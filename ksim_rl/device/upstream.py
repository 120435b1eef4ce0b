"""Undocumented interfaces of torch and Warp that `device` uses.

Each part says why it is needed and with which version it was checked; `tests/device/test_upstream.py` names the part
that a new version moved.
"""

import ctypes
import functools
import itertools
import re
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import warp as wp

# torch 2.10 to 2.14 and Warp 1.19: exceptions of a failed allocation carry no size, only these texts do (Warp's, then
# torch's on CUDA and on the CPU).
ALLOCATION_REFUSALS = (
    r"Failed to allocate (?P<size>\d+) bytes",
    r"Tried to allocate (?P<size>[\d.]+) (?P<unit>[KMG]iB)",
    r"can't allocate memory: you tried to allocate (?P<size>\d+) bytes",
)
# Warp 1.19 has no hook for compilations. It ends a module's load line with "took 812.34 ms  (compiled)", or "(cached)".
COMPILED_LINE = re.compile(r"^\s*Module (?P<module>\S+).* took (?P<ms>[\d.]+) ms\s+\(compiled\)")
# Warp 1.19 writes this from native code when it starts without a driver, and has no setting against it.
ABSENT_DRIVER = "Could not find or load the NVIDIA CUDA driver"

# Warp 1.19 raises a bare exception with these words where the file of a compiled module is none.
UNLOADABLE = "Failed to load "
# Clang's, which Warp 1.19 carries.
TEMPLATES_IN_HEADER = "-fpch-instantiate-templates"


def current_stream_handle(device: torch.device) -> int:
    """Return the handle of torch's current CUDA stream.

    The documented way makes a stream object, which takes longer than a launch. Checked with torch 2.10 to 2.13; 2.14.1
    has it, and was not tried on a GPU.
    """
    return torch._C._cuda_getCurrentRawStream(device.index)  # pyright: ignore[reportAttributeAccessIssue]


def free_cublas_workspaces() -> None:
    """Forget the memory that matrix products took, on Hopper 32 MiB for each stream; the next one takes it again.

    Torch keeps it for ever. Its own graph trees do this before a capture, so that it lies in a graph's pool. The name
    is torch 2.13's, and 2.14.1 has it.
    """
    torch._C._cuda_clearCublasWorkspaces()


def recorded_arguments(launch: wp.Launch) -> ctypes.Structure:
    """Return the bytes of the one struct that a recorded launch passes to its kernel, for writing them in one go.

    `Launch.set_param_at_index` packs field by field. The first parameter is the launch's size. Checked with Warp 1.19.
    """
    return launch.params[1]


def has_default_logger() -> bool:
    """Return whether the program has set no logger of its own. Checked with Warp 1.19, which does not tell."""
    return type(wp.get_logger()).__name__ == "LoggerBasic"


def put_apart(kernels: Collection[wp.Kernel]) -> None:
    """Give kernels a module of their own where theirs has others, too, and is not loaded on any device.

    Warp compiles whole modules, which takes 6 s for one of MuJoCo Warp's with 38 kernels, however few a robot needs.
    The old module keeps all of its kernels: a launch of the others compiles it as ever. Checked with Warp 1.19.
    """
    for module in {kernel.module for kernel in kernels}:
        some = {kernel for kernel in kernels if kernel.module is module}
        # A loaded module must stay as it is; one whose kernels are all wanted has nothing to leave out.
        if module.execs or some >= {*module.kernels.values()}:
            continue
        # The one of this name if there is one: on the CPU, what is loaded is told apart by the names of modules.
        own = wp.get_module(f"{module.name}.{min(kernel.key for kernel in some)}")
        # The kernels keep the options that they were written with.
        own.options |= module.options
        own.has_unresolved_static_expressions |= module.has_unresolved_static_expressions
        for kernel in some:
            own.register_kernel(kernel)
        # Last, as another thread may launch one meanwhile.
        for kernel in some:
            kernel.module = own


def with_preamble(text: str) -> wp.ModuleBuildOptions:
    """Return the options of a module whose C++ begins with a text, which is a part of its hash in Warp's cache.

    Warp calls them experimental. Checked with Warp 1.19.
    """
    return wp.ModuleBuildOptions(extra_cpu_preamble=text, extra_cuda_preamble=text)


def keep_templates_in_header() -> None:
    """Put the results of Warp's templates into its precompiled header.

    Without the flag each module for the CPU works them out again, in 0.09 s of the 0.1 to 0.2 s that one takes. The
    machine code is the same, byte for byte. Checked with Warp 1.19.
    """
    # Warp's meaning of None.
    flags = wp.config.cpu_compiler_flags
    if flags is None:
        flags = "-march=native"
    if TEMPLATES_IN_HEADER not in flags.split():
        wp.config.cpu_compiler_flags = f"{flags} {TEMPLATES_IN_HEADER}".lstrip()


def watch_loads(mend: Callable[[Path, Exception, int], None]) -> None:
    """Call `mend(folder, error, attempt)` where files of the cache cannot be read, and load that module once more.

    Warp takes the files of its cache as they are, and has no setting for another attempt. Replaces `wp.Module.load`,
    checked with Warp 1.19.
    """
    load = wp.Module.load

    @functools.wraps(load)
    def load_or_mend(
        self: wp.Module, device: Any, block_dim: int | None = None, *given: Any, **named: Any
    ) -> Any:
        # The hook raises when another attempt is in vain.
        for attempt in itertools.count(1):
            try:
                return load(self, device, block_dim, *given, **named)
            except Exception as error:
                # The folder name depends on the module's hash and block size.
                folder = Path(wp.config.kernel_cache_dir) / self.get_module_identifier(block_dim)
                # What is no JSON or no text is a ValueError; what does not compile is none of these.
                is_read = folder.exists() and (
                    isinstance(error, ValueError) or UNLOADABLE in str(error)
                )
                if given or named or not (is_read or isinstance(error, OSError)):
                    raise
                mend(folder, error, attempt)
        raise AssertionError

    wp.Module.load = load_or_mend


_diversion = threading.Lock()


@contextmanager
def launches_diverted(
    instead: Callable[[wp.Kernel, int | Sequence[int], int | None], None],
) -> Iterator[None]:
    """Call `instead(kernel, dim, block_dim)` for each launch that this thread issues in this block.

    Loops of Warp go through their body once. Warp can only load modules that it is given, and which kernels a library
    launches is known to no other code. Replaces functions of the module `warp`, checked with Warp 1.19.
    """
    thread = threading.get_ident()

    def note(kernel: wp.Kernel, dim: int | Sequence[int], *args: Any, **kwargs: Any) -> None:
        instead(kernel, dim, kwargs.get("block_dim"))

    def loop_once(
        condition: wp.array, while_body: Callable[..., None], *args: Any, **kwargs: Any
    ) -> None:
        while_body(**kwargs)

    def for_this_thread(
        original: Callable[..., None], replacement: Callable[..., None]
    ) -> Callable[..., None]:
        # Other threads go on launching.
        return lambda *args, **kwargs: (
            replacement if threading.get_ident() == thread else original
        )(*args, **kwargs)

    namespace: Any = vars(wp)
    replacements = {"launch": note, "launch_tiled": note, "capture_while": loop_once}
    # One diversion at a time: overlapping ones would restore each other's replacements.
    with _diversion:
        saved = {name: namespace[name] for name in replacements}
        namespace.update(
            {name: for_this_thread(saved[name], new) for name, new in replacements.items()}
        )
        try:
            yield
        finally:
            namespace.update(saved)
