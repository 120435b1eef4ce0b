"""Kernels are compiled side by side here, and a notice says so, as it would look like a hang otherwise.

The first use of a model compiles its kernels: 15 to 45 s, once per machine, then cached. Warp's own module-load lines
are dropped; in their place each compiled module calls one hook with one line of text. The default hook writes the
first line of a burst to stderr; a program with its own display sets another:

    with compile_notice(lambda text: status.update(text)):
        world.step(1)
"""

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, partial

import torch
import warp as wp

from ksim_rl.device import upstream
from ksim_rl.device.quick_launch import QuickLaunch
from ksim_rl.device.streams import warp_device
from ksim_rl.terminal import show

CompileHook = Callable[[str], None]
# A process with more compilers than this waits for its disk.
MOST_WORKERS = 16
# Compilations further apart than this belong to another model.
BURST_GAP_S = 60.0


class CompileLogger:
    """A Warp logger that drops information lines and turns compilations into calls of a hook."""

    def __init__(self, hook: CompileHook) -> None:
        self.hook = hook
        self.count = 0
        self.seconds = 0.0
        self.last_time = -BURST_GAP_S

    def debug(self, message: str) -> None:
        """Drop Warp's debug lines."""

    def info(self, message: str) -> None:
        """Drop Warp's information lines, and report those that tell of a compiled module."""
        match = upstream.COMPILED_LINE.match(message)
        # Lines of modules that come from the cache are dropped, too.
        if match is None:
            return
        now = time.monotonic()
        # A new burst is counted from 1.
        if now - self.last_time > BURST_GAP_S:
            self.count = 0
            self.seconds = 0.0
        self.last_time = now
        self.count += 1
        self.seconds += float(match["ms"]) / 1000.0
        self.hook(
            f"compiling Warp kernels (first use of this model, cached in {wp.config.kernel_cache_dir}): "
            f"{self.count} modules, {self.seconds:.0f} s"
        )

    def warning(
        self, message: str, category: type[Warning] | None = None, stacklevel: int = 1
    ) -> None:
        """Write Warp's warnings to stderr."""
        show(f"Warp warning: {message}", to_stderr=True)

    def error(self, message: str) -> None:
        """Write Warp's errors to stderr."""
        show(f"Warp error: {message}", to_stderr=True)


def say_first(text: str) -> None:
    """Write the first line of a burst of compilations to stderr; the default hook."""
    if _logger.count == 1:
        show(f"{text.rsplit(':', 1)[0]} ...", to_stderr=True)


_logger = CompileLogger(say_first)


if upstream.has_default_logger():  # one that the program set itself stays
    wp.set_logger(_logger)


@contextmanager
def compile_notice(hook: CompileHook) -> Iterator[None]:
    """Call `hook` with one line of text after each kernel module that Warp compiles in this block, counted from 1."""
    saved = _logger.hook
    # The next compilation begins a new burst for this hook.
    _logger.hook = hook
    _logger.last_time = -BURST_GAP_S
    try:
        yield
    finally:
        _logger.hook = saved


@contextmanager
def loaded_together(device: torch.device) -> Iterator[None]:
    """Run none of the launches that this thread issues in this block, but load their kernels, side by side, at its end.

    One after another, a new model takes half a minute. Loops of Warp (`wp.capture_while`) go through their body once.
    Kernels that take their types from a launch are left to that launch. Each `QuickLaunch` that exists is loaded, too.
    """
    found: dict[tuple[wp.Kernel, int | None], None] = {}

    def note(kernel: wp.Kernel, dim: int | Sequence[int], block_dim: int | None) -> None:
        # A dim may be a single number.
        if isinstance(dim, (tuple, list)):
            size = dim
        else:
            size = (dim,)
        # An empty launch loads nothing, and a generic kernel has no types before its launch.
        if all(size) and not kernel.is_generic:
            found[kernel, None if device.type == "cpu" else block_dim] = None

    with upstream.launches_diverted(note):
        yield
        # Before another thread comes here: it would put apart again what is not loaded yet.
        upstream.put_apart([kernel for kernel, _ in found])
        modules = dict.fromkeys((kernel.module, block_dim) for kernel, block_dim in found)
        load([*modules, *(quick.loadable for quick in QuickLaunch.existing)], device)


def load(modules: Iterable[tuple[wp.Module, int | None]], device: torch.device) -> None:
    """Compile and load modules, side by side, for launches of the block sizes beside them; of any on the CPU."""
    of_cpu = device.type == "cpu"
    load_one = partial(wp.force_load, warp_device(device), max_workers=0)
    # On the CPU a kernel is compiled for one thread whatever it is launched with.
    loads = [
        partial(load_one, [module], None if of_cpu else block_dim) for module, block_dim in modules
    ]
    workers = min(os.cpu_count() or 1, MOST_WORKERS)
    if workers == 1:
        for load_it in loads:
            load_it()
        return
    waiting = [_compilers(workers).submit(load_it) for load_it in loads]
    # Waits for each, so that none goes on behind an exception of another.
    for one in waiting:
        one.exception()
    for one in waiting:
        one.result()


@cache
def _compilers(count: int) -> ThreadPoolExecutor:
    """Threads that stay for later models: Warp precompiles its header for each thread, for the CPU in a second."""
    return ThreadPoolExecutor(count, thread_name_prefix="kernel_compiler")


# A forked child has none of its parent's threads, and would wait for them.
os.register_at_fork(after_in_child=_compilers.cache_clear)
