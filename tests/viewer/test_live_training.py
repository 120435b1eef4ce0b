"""A training gives its weights to the viewer while a page is open, and otherwise does nothing for it."""

from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("viser", reason="viser is not installed (the extra `viewer`)")
from ksim_rl.testing import count_syncs
from ksim_rl.trainers import Hook
from ksim_rl.viewer.live_training import WEIGHTS, GiveWeights
from tests.trainers.target_env import make_trainer


class After(Hook):
    """Calls a function after each iteration, as the last of the hooks."""

    def __init__(self, then):
        self._then = then

    def __call__(self, trainer):
        self._then(trainer)


def train(*hooks):
    """Return how often a run read the device in its iterations after the first, and after which it waited for it."""
    trainer = make_trainer(iterations=4, hooks=hooks, overlap=True)
    iterate, settle = trainer.iterate, trainer.settle
    read, waited = [], []

    def counted():
        with count_syncs() as syncs:
            iterate()
        read.append(syncs.total)

    trainer.iterate, trainer.settle = counted, lambda: (waited.append(trainer.iteration), settle())
    trainer.train()
    return read[1:], waited


def test_while_nobody_watches_a_run_is_as_without_a_viewer(tmp_path):
    hook = GiveWeights(tmp_path)
    assert train(hook) == train() == ([1, 1, 1], [4])
    assert not list(tmp_path.iterdir())


def test_weights_are_given_between_iterations_while_somebody_watches(tmp_path):
    hook, seen = GiveWeights(tmp_path), []
    hook.is_watched = True

    def look(trainer):
        path = tmp_path / WEIGHTS
        if path.exists():
            saved = torch.load(path, weights_only=True)
            own = trainer.update.actor.state_dict()
            seen.append(
                (
                    saved["iteration"],
                    all(own[name].equal(held) for name, held in saved["actor"].items()),
                )
            )
            assert saved["actor"].keys() == own.keys()
            path.unlink()
        hook.is_watched = False

    read, _ = train(hook, After(look))
    assert seen == [(1, True)]  # it left after the first iteration
    assert read == [0, 0, 0]  # what there was to read was read before each look


def test_the_weights_are_rare(tmp_path, monkeypatch):
    """Of iterations of 0.3 s, about every seventh gives them: every 2 s."""
    now, given = 0.0, []
    monkeypatch.setattr("ksim_rl.viewer.live_training.time.monotonic", lambda: now)
    hook = GiveWeights(tmp_path)
    hook.is_watched = True
    trainer = SimpleNamespace(iteration=0, update=SimpleNamespace(actor=torch.nn.Linear(1, 1)))
    for trainer.iteration in range(1, 23):
        now += 0.3
        if trainer.iteration % hook.interval == 0:
            hook(trainer)
            given.append(torch.load(tmp_path / WEIGHTS, weights_only=True)["iteration"])
    assert given == [1, 2, 7, 14, 21]
