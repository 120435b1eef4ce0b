"""Graphs are recorded again where what they were recorded from has changed; what changes often is not recorded."""

import warnings

import pytest
import torch
from torch import nn

from ksim_rl.compiled.watched_graphs import WatchedGraphs


class Loss(nn.Module):
    """A loss with a number that a program may change."""

    def __init__(self):
        super().__init__()
        self.clip_epsilon = 0.2
        self.seen = []


class Graph:
    """Stands for a CUDA graph of a loss: it has the number of when it was recorded, in its second call."""

    def __init__(self, loss):
        self.loss, self.is_eager, self.calls, self.held = loss, False, 0, None
        self.results = []

    @property
    def ready(self):
        return self.held is not None

    def forget(self):
        self.held, self.calls = None, 0

    def __call__(self):
        if self.ready and not self.is_eager:
            self.results.append(self.held)
            return
        self.calls += 1
        self.loss.seen.append(self.calls)
        self.results.append(self.loss.clip_epsilon)
        if self.calls == 2 and not self.is_eager:
            self.held = self.loss.clip_epsilon


def calling(graph, watched, values):
    for value in values:
        graph.loss.clip_epsilon = value
        with watched.watched():
            graph()
    return graph.results


def made():
    loss = Loss()
    graph = Graph(loss)
    return graph, WatchedGraphs([graph], {"loss": loss}, torch.device("cpu"))


def test_a_change_from_outside_is_followed_and_said():
    graph, watched = made()
    with pytest.warns(
        RuntimeWarning, match=r"loss\.clip_epsilon was 0\.2 and is 0\.1 since .* recorded again"
    ):
        assert calling(graph, watched, (0.2, 0.2, 0.2, 0.1, 0.1, 0.1)) == [
            0.2,
            0.2,
            0.2,
            0.1,
            0.1,
            0.1,
        ]
    assert graph.ready


def test_what_the_calls_change_themselves_is_no_change():
    graph, watched = made()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        calling(graph, watched, [0.2] * 6)
    assert graph.calls == 2


def test_what_changes_again_and_again_runs_in_python():
    graph, watched = made()
    values = [0.1 * (step // 3) for step in range(30)]
    with pytest.warns(RuntimeWarning, match="SLOWER"):
        assert calling(graph, watched, values) == values
    assert graph.is_eager
