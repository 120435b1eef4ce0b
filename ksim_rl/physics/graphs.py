"""A world records each kind of launch sequence once as a graph of its own, and replays it from then on."""

from collections.abc import Callable, Hashable

import torch
import warp as wp

from ksim_rl.device.capture import (
    is_capturing,
    is_warming_up,
    no_collection,
    refuse_or_warn,
    wants_live_launches,
)
from ksim_rl.device.streams import warp_device, warp_scope, warp_stream


class WarpGraphs:
    """Warp graphs by key, for sequences of Warp launches on arrays that keep their addresses.

    On CPU the first run records the graph and replays it. On CUDA the first run is eager, so that all kernels are
    loaded, and the second one records. Inside an outer capture nothing is recorded here: launches go into that graph.
    The warm-up of an outer capture replays the graphs that exist, and records none: they would not be used again.
    """

    def __init__(self, device: torch.device, *, require_graphs: bool = False) -> None:
        self.device = device
        self._available = refuse_or_warn(device, require_graphs=require_graphs)
        self._graphs: dict[Hashable, wp.Graph] = {}
        self._warm: set[Hashable] = set()
        self._joined: list[wp.Graph | None] = []
        # The default stream cannot record, so graphs are recorded on a stream of our own and launched on any.
        self._stream = wp.Stream(warp_device(device)) if device.type == "cuda" else None

    def run(self, key: Hashable, launches: Callable[[], None]) -> None:
        """Run `launches`, in order with torch's current stream. `key` names what it does."""
        with warp_scope(self.device):
            replays = is_warming_up() and key in self._graphs
            if not self._available or (wants_live_launches(self.device) and not replays):
                self._launch_live(launches)
                return
            if key not in self._graphs:
                if self._stream is not None and key not in self._warm:
                    self._warm.add(key)
                    launches()
                    return
                self._graphs[key] = self._record(launches)
            stream = None if self._stream is None else warp_stream(torch.cuda.current_stream(self.device))
            wp.capture_launch(self._graphs[key], stream=stream)

    def clear(self) -> None:
        """Forget all graphs, and free what they hold."""
        self._graphs.clear()
        self._warm.clear()
        self._joined.clear()

    def _launch_live(self, launches: Callable[[], None]) -> None:
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
            with (
                no_collection(),
                wp.ScopedStream(self._stream, sync_enter=False, sync_exit=False),
                wp.ScopedCapture(stream=self._stream) as recorded,
            ):
                launches()
        assert recorded.graph is not None
        return recorded.graph
