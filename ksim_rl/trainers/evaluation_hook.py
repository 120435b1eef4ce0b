"""Evaluations at an interval, and of the final policy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ksim_rl.trainers.evaluation import Evaluator
from ksim_rl.trainers.hook import Hook

if TYPE_CHECKING:
    from ksim_rl.trainers.trainer import Trainer


class EvaluationHook(Hook):
    """Judges the policy in envs of its own, and logs the figures."""

    def __init__(self, evaluator: Evaluator, *, interval: int) -> None:
        self.evaluator, self.interval = evaluator, interval
        self._evaluated_at: int | None = None

    def __call__(self, trainer: Trainer) -> None:
        """Evaluate, unless a signal asks to stop meanwhile."""
        with trainer.clock.paused():
            evaluation = self.evaluator(stop=trainer.interrupt.__bool__)
        if evaluation is None:
            return
        trainer.evaluation, self._evaluated_at = evaluation, trainer.iteration
        trainer.log({f"evaluation/{name}": value for name, value in evaluation.as_dict().items()})

    def at_end(self, trainer: Trainer) -> None:
        """Evaluate the final policy, once."""
        if not trainer.interrupt and self._evaluated_at != trainer.iteration:
            self(trainer)
