"""Records CUDA graphs again when Python values have changed that they were recorded from."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch

from ksim_rl.compiled.python_values import Parts
from ksim_rl.compiled.python_watch import PythonWatch, listed
from ksim_rl.device.capture import Captured

MOST_RECORDINGS = 4
"""Recordings after which Python runs at each call: values that change as often would be recorded for ever."""


class WatchedGraphs:
    """Keeps graphs of the same work true to the Python values of their `parts`, by name: a replay runs no Python.

    `watched` is around each call of one of the graphs, a list that may grow.
    """

    def __init__(self, graphs: Sequence[Captured], parts: Parts, device: torch.device) -> None:
        self._graphs = graphs
        self._parts = parts
        self._watch = PythonWatch(device)
        self._num_ready = self._times = 0

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Forget the graphs before a call if something has changed, and say so."""
        # Before the first graph is ready, Python itself runs and nothing can be stale.
        if self._num_ready:
            changes = self._watch.changes()
            if changes:
                self._forget(listed(changes))
        yield
        # More graphs than before: one was captured in this call.
        num_ready = sum(graph.ready for graph in self._graphs)
        if num_ready != self._num_ready:
            # The call has made its own changes in Python by now; from here on each change comes from outside.
            self._watch.look(self._parts)
            self._num_ready = num_ready

    def _forget(self, changes: str) -> None:
        self._times += 1
        self._num_ready = 0
        runs_python = self._times >= MOST_RECORDINGS
        if runs_python:
            what = "Python runs from now on, which is SLOWER"
        else:
            what = "they are recorded again"
        warnings.warn(
            f"{changes} since CUDA graphs were recorded: {what}. What changes often belongs in a tensor that is "
            "written in place",
            RuntimeWarning,
            stacklevel=4,
        )
        for graph in self._graphs:
            graph.forget()
            # Once eager, a graph stays so for the rest of the run.
            graph.is_eager |= runs_python
