"""Work of torch and Warp is captured here in one graph, which torch owns, and work of Warp alone in graphs of its own.

Inside the body that is captured for torch, worlds issue live launches: a finished Warp graph cannot be launched there.
"""

import gc
import threading
import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from weakref import WeakSet

import torch
import warp as wp

from ksim_rl.checks import check_count
from ksim_rl.device import recording, upstream
from ksim_rl.device.eager import runs_eagerly
from ksim_rl.device.streams import checked_device, warp_device, warp_scope, warp_stream


class _Phase(threading.local):
    """The state of this thread inside a `Captured`."""

    live = 0
    warming_up = 0
    capturing = 0


_phase = _Phase()
# Those that exist, by device, whose pool of memory the next one shares.
_graphs: dict[torch.device, WeakSet[torch.cuda.CUDAGraph]] = {}


@cache
def _capture_stream(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)


def is_capturing() -> bool:
    """Whether a `Captured` of this thread is recording its graph right now."""
    return _phase.capturing > 0


def _wants_live_launches(device: torch.device) -> bool:
    """Whether no graph may be recorded here: an outer one is recorded, or warms up to be."""
    if _phase.live > 0:
        return True
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def _refuse_or_warn(device: torch.device, *, require_graphs: bool) -> bool:
    """Return whether graphs can be used on `device`; say it loudly, or refuse, where they cannot."""
    if device.type == "cpu" or wp.is_mempool_enabled(warp_device(device)):
        return True
    reason = (
        f"Warp's memory pool is off on {device}, and graphs cannot allocate without it; unset "
        "WARP_ENABLE_MEMPOOLS_AT_INIT, or use a driver that supports memory pools"
        # Warp's CPU graphs need no memory pool.
    )
    if require_graphs:
        raise RuntimeError(f"require_graphs=True, but {reason}")
    # The warning points at the caller of the constructor that asked.
    warnings.warn(
        f"RUNNING WITHOUT GRAPHS, about 13 times slower: {reason}", RuntimeWarning, stacklevel=3
    )
    return False


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep the garbage collector out of a capture: a free in the middle of it would invalidate the graph."""
    was_enabled = gc.isenabled()
    # Collection may have been off before, and must then stay off.
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
    # Counters, not flags, since these blocks nest.
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

    The first `warmup` calls run eagerly on a side stream (their work counts), the next one records the graph, and
    from then on each call replays it. So `body` must be fit for replay: it reads and writes tensors that stay where
    they are, allocates no size that depends on data, and neither syncs with the host nor branches on tensor values.
    Its Python runs only while it is eager or recorded; where that changes, `forget` the graph. It may
    draw from the device's default random generator. The graphs of a device have their temporaries in the same memory:
    no two may run at the same time, and a tensor that one makes lasts as long as something refers to it. With
    `require_graphs`, a CUDA device without graphs is refused instead of a warning and eager calls. Calls are eager
    while `is_eager`, which stays true for those that are made within `eagerly`.
    """

    def __init__(
        self,
        body: Callable[[], None],
        *,
        device: str | torch.device,
        warmup: int = 2,
        require_graphs: bool = False,
    ) -> None:
        check_count("warmup", warmup)  # kernels cannot be compiled in a capture
        self.body = body
        self.device = checked_device(device)
        self.warmup = warmup
        self.is_eager = runs_eagerly()
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warp_graph: wp.Graph | None = None
        # Decided once, so that the warning is given once.
        self._eager_for_ever = self.device.type == "cpu" or not _refuse_or_warn(
            self.device, require_graphs=require_graphs
        )
        # One for all: temporaries belong to the stream that they were made on.
        if self._eager_for_ever:
            self._stream = None
        else:
            self._stream = _capture_stream(self.device)

    @property
    def ready(self) -> bool:
        """Whether the next call replays a graph."""
        return self._graph is not None

    def forget(self) -> None:
        """Drop the graph: the next call is eager, as the body may need other kernels now, and the one after records."""
        if self._graph is not None and self.device.type == "cuda":
            torch.cuda.synchronize(self.device)  # it may still run
        # Both graphs go together: Warp's only keeps kernels loaded for torch's.
        self._graph = self._warp_graph = None
        # One eager call remains, which loads kernels that the body needs now.
        self._calls = min(self._calls, self.warmup - 1)

    def __call__(self) -> None:
        """Run the body: eagerly at first, then as one graph."""
        if self._graph is not None and not self.is_eager:
            self._graph.replay()
        elif self._stream is None or self.is_eager or _wants_live_launches(self.device):
            # Worlds have graphs of their own where no outer one is to be recorded.
            # Inside another capture, the body is simply a part of that graph.
            self.body()
        elif self._calls < self.warmup:
            self._calls += 1
            self._run_eagerly(self._stream)
        else:
            self._graph, self._warp_graph = self._record(self._stream)
            # Recording runs nothing, so this call's work is the first replay.
            self._graph.replay()

    def _run_eagerly(self, stream: torch.cuda.Stream) -> None:
        # The side stream waits for the caller's work, and the caller for the body's.
        caller = torch.cuda.current_stream(self.device)
        # Events order both streams without waiting on the host.
        stream.wait_stream(caller)
        with (
            torch.cuda.stream(stream),
            # Warp adds no waits of its own: those above and below order the two streams.
            wp.ScopedStream(warp_stream(stream), sync_enter=False, sync_exit=False),
            live_launches(warming_up=True),
        ):
            self.body()
        caller.wait_stream(stream)

    def _record(self, stream: torch.cuda.Stream) -> tuple[torch.cuda.CUDAGraph, wp.Graph]:
        warp_side = warp_stream(stream)
        # Work in flight may use memory that is freed next.
        torch.cuda.synchronize(self.device)
        # Give back the memory of the eager calls: graphs have a pool of their own, and would take it again.
        upstream.free_cublas_workspaces()
        torch.cuda.empty_cache()
        graph = torch.cuda.CUDAGraph()
        # Sharing one pool lets graphs that never run at the same time have the same temporaries.
        others = _graphs.setdefault(self.device, WeakSet())
        pool = next((other.pool() for other in others), None)
        with (
            no_collection(),
            torch.cuda.stream(stream),
            wp.ScopedStream(warp_side, sync_enter=False, sync_exit=False),
            live_launches(capturing=True),
        ):
            # In "thread_local" mode, other threads (a viewer, a logger) may call CUDA meanwhile.
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                # Warp joins torch's capture, so that its launches and allocations go into the same graph.
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
        # Held weakly: a pool lives as long as one of its graphs.
        others.add(graph)
        return graph, warp_graph


class WarpGraphs:
    """Warp graphs by key, for sequences of Warp launches on arrays that keep their addresses.

    On CPU the first run records the graph and replays it. On CUDA the first run is eager, so that all kernels are
    loaded, and the second one records. Inside an outer capture nothing is recorded here: launches go into that graph.
    The warm-up of an outer capture replays the graphs that exist, and records none: they would not be used again.
    """

    def __init__(self, device: torch.device, *, require_graphs: bool = False) -> None:
        self.device = device
        self._available = _refuse_or_warn(device, require_graphs=require_graphs)
        self._graphs: dict[Hashable, wp.Graph] = {}
        # Keys whose kernels an eager run has loaded: loading inside a capture fails.
        self._warm: set[Hashable] = set()
        self._joined: list[wp.Graph | None] = []
        # The default stream cannot record, so graphs are recorded on a stream of our own and launched on any.
        if device.type == "cuda":
            self._stream = wp.Stream(warp_device(device))
        else:
            self._stream = None

    def run(self, key: Hashable, launches: Callable[[], None], *, live: bool = False) -> None:
        """Run `launches`, in order with torch's current stream. `key` names the work.

        Where they are `live`, they are issued one by one each time, since their Python has to run.
        """
        # While operations are written down, the launch becomes an entry of the recording.
        if recording.launched(lambda: self.run(key, launches, live=live)):
            return
        with warp_scope(self.device):
            # A warm-up may replay, but a capture in progress cannot hold another graph.
            replays = _phase.warming_up and key in self._graphs
            if live or not self._available or (_wants_live_launches(self.device) and not replays):
                self._launch_live(launches)
                return
            if key not in self._graphs:
                # The first run on CUDA is eager, and its work counts.
                if self._stream is not None and key not in self._warm:
                    self._warm.add(key)
                    launches()
                    return
                self._graphs[key] = self._record(launches)
            # CPU graphs have no stream; CUDA graphs run in order with torch's work.
            if self._stream is None:
                stream = None
            else:
                stream = warp_stream(torch.cuda.current_stream(self.device))
            wp.capture_launch(self._graphs[key], stream=stream)

    def clear(self) -> None:
        """Forget all graphs, and free their memory."""
        self._graphs.clear()
        self._warm.clear()
        self._joined.clear()

    def _launch_live(self, launches: Callable[[], None]) -> None:
        # Inside a `Captured`, Warp has joined the capture already.
        if self._stream is None or is_capturing() or not torch.cuda.is_current_stream_capturing():
            launches()
            return
        # A capture that torch began by itself: Warp must join it, or its loops would sync with the host.
        stream = warp_stream(torch.cuda.current_stream(self.device))
        with wp.ScopedCapture(stream=stream, external=True) as joined:
            launches()
        # It keeps the kernels loaded that torch's graph launches.
        self._joined.append(joined.graph)

    def _record(self, launches: Callable[[], None]) -> wp.Graph:
        if self._stream is None:
            with wp.ScopedCapture(device="cpu") as recorded:
                launches()
        else:
            # A free or a sync in this block would invalidate the graph.
            with (
                no_collection(),
                wp.ScopedStream(self._stream, sync_enter=False, sync_exit=False),
                wp.ScopedCapture(stream=self._stream) as recorded,
            ):
                launches()
        assert recorded.graph is not None
        return recorded.graph
