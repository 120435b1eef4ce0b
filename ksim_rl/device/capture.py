"""This module captures work of torch and Warp in one graph, which torch owns and whose capture Warp joins.

Inside the captured body, worlds issue live launches: a finished Warp graph cannot be launched inside a capture.
"""

import gc
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

import torch
import warp as wp

from ksim_rl.device.streams import checked_device, warp_device, warp_stream


class _Phase(threading.local):
    """What this thread is doing inside a `Captured`."""

    live = 0
    warming_up = 0
    capturing = 0


_phase = _Phase()


def is_capturing() -> bool:
    """Whether a `Captured` of this thread is recording its graph right now."""
    return _phase.capturing > 0


def is_warming_up() -> bool:
    """Whether a `Captured` of this thread runs its body eagerly right now, before it records its graph."""
    return _phase.warming_up > 0


def wants_live_launches(device: torch.device) -> bool:
    """Whether no graph may be recorded here: an outer one is recorded, or warms up to be."""
    if _phase.live > 0:
        return True
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def refuse_or_warn(device: torch.device, *, require_graphs: bool) -> bool:
    """Return whether graphs can be used on `device`; say it loudly, or refuse, where they cannot.

    Raises:
        RuntimeError: with `require_graphs`, naming the reason.
    """
    if device.type == "cpu" or wp.is_mempool_enabled(warp_device(device)):
        return True
    reason = (
        f"Warp's memory pool is off on {device}, and graphs cannot allocate without it; unset "
        "WARP_ENABLE_MEMPOOLS_AT_INIT, or use a driver that supports memory pools"
    )
    if require_graphs:
        raise RuntimeError(f"require_graphs=True, but {reason}")
    warnings.warn(f"RUNNING WITHOUT GRAPHS, about 13 times slower: {reason}", RuntimeWarning, stacklevel=3)
    return False


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep the garbage collector out of a capture: a free in the middle of it would invalidate the graph."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextmanager
def live_launches(*, warming_up: bool = False, capturing: bool = False) -> Iterator[None]:
    """Let worlds issue launch by launch in this block, as they do inside a capture, and record no graphs of theirs.

    With `warming_up` they replay the graphs that they have.
    """
    _phase.live += 1
    _phase.warming_up += warming_up
    _phase.capturing += capturing
    try:
        yield
    finally:
        _phase.live -= 1
        _phase.warming_up -= warming_up
        _phase.capturing -= capturing


class Captured:
    """A function without arguments that becomes one CUDA graph; on CPU it stays a plain call.

    The first `warmup` calls run eagerly on a private stream (their work counts), the next one records the graph, and
    from then on each call replays it. So `body` must be fit for replay: it reads and writes tensors that stay where
    they are, allocates no size that depends on data, and neither syncs with the host nor branches on tensor values.
    What it does in Python happens only while it is eager or recorded.

    Args:
        body: what to capture.
        device: where it runs.
        warmup: number of eager calls before the capture; at least one, so that all kernels are loaded.
        require_graphs: refuse a CUDA device on which graphs are unavailable, instead of a warning and eager calls.
        generators: random generators, other than the device's default, that `body` draws from.
    """

    def __init__(
        self,
        body: Callable[[], None],
        *,
        device: str | torch.device,
        warmup: int = 2,
        require_graphs: bool = False,
        generators: Sequence[torch.Generator] = (),
    ) -> None:
        if warmup < 1:
            raise ValueError(
                f"warmup={warmup}: expected at least 1, since kernels cannot be compiled in a capture"
            )
        self.body = body
        self.device = checked_device(device)
        self.warmup = warmup
        self._generators = tuple(generators)
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warp_graph: wp.Graph | None = None
        self._eager_for_ever = self.device.type == "cpu" or not refuse_or_warn(
            self.device, require_graphs=require_graphs
        )
        # Kept as long as the graph: its temporaries belong to this stream.
        self._stream = None if self._eager_for_ever else torch.cuda.Stream(self.device)

    @property
    def ready(self) -> bool:
        """Whether the next call replays a graph."""
        return self._graph is not None

    def __call__(self) -> None:
        """Run the body: eagerly at first, then as one graph."""
        if self._graph is not None:
            self._graph.replay()
        elif self._stream is None or wants_live_launches(self.device):
            # Inside another capture, the body is simply a part of that graph.
            self.body()
        elif self._calls < self.warmup:
            self._calls += 1
            self._run_eagerly(self._stream)
        else:
            self._graph, self._warp_graph = self._record(self._stream)
            self._graph.replay()

    def _run_eagerly(self, stream: torch.cuda.Stream) -> None:
        caller = torch.cuda.current_stream(self.device)
        stream.wait_stream(caller)
        with (
            torch.cuda.stream(stream),
            wp.ScopedStream(warp_stream(stream), sync_enter=False, sync_exit=False),
            live_launches(warming_up=True),
        ):
            self.body()
        caller.wait_stream(stream)

    def _record(self, stream: torch.cuda.Stream) -> tuple[torch.cuda.CUDAGraph, wp.Graph]:
        warp_side = warp_stream(stream)
        torch.cuda.synchronize(self.device)
        graph = torch.cuda.CUDAGraph()
        for generator in self._generators:
            graph.register_generator_state(generator)
        with (
            no_collection(),
            torch.cuda.stream(stream),
            wp.ScopedStream(warp_side, sync_enter=False, sync_exit=False),
            live_launches(capturing=True),
        ):
            graph.capture_begin(capture_error_mode="thread_local")
            try:
                wp.capture_begin(stream=warp_side, external=True)
                self.body()
                # It holds no graph of its own, but keeps the kernels loaded that torch's graph launches.
                warp_graph = wp.capture_end(stream=warp_side)
                graph.capture_end()
            except Exception as error:
                # Leave both captures; they complain about the broken graph, which the first error explains.
                for end in (lambda: wp.capture_end(stream=warp_side), graph.capture_end):
                    with suppress(RuntimeError):
                        end()
                raise RuntimeError(
                    f"the body cannot be captured in a CUDA graph: {error}. It must not sync with the host (.item(), "
                    "branching on a tensor, boolean indexing), nor allocate a size that depends on data"
                ) from error
        return graph, warp_graph
