"""A hook is something that a run does between iterations: evaluations, checkpoints, and what users add."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from ksim_rl.collectors import RolloutCollector
from ksim_rl.trainers.algorithm import Update
from ksim_rl.trainers.evaluation import Evaluation, Evaluator
from ksim_rl.trainers.interrupt import InterruptRequest
from ksim_rl.trainers.progress import RunClock, RunProgress


class Run(Protocol):
    """What a hook may use of the `Trainer` that calls it.

    Attributes:
        iteration: how many are done.
        saved_at: the iteration of the last checkpoint; -1 before the first.
        metrics: those of the present iteration.
        evaluation: the last one.
        folder: of checkpoints; None saves none.
        collector, update, progress, clock, interrupt: the run's parts.
    """

    iteration: int
    saved_at: int
    metrics: dict[str, float]
    evaluation: Evaluation | None
    folder: Path | None
    collector: RolloutCollector
    update: Update
    progress: RunProgress
    clock: RunClock
    interrupt: InterruptRequest

    def log(self, figures: Mapping[str, float]) -> None:
        """Add figures of the present iteration to its metrics, and write them to the loggers."""

    def save(self) -> Path:
        """Write a checkpoint."""
        ...


class Hook:
    """Something to do between iterations: an evaluation, a schedule of your own, a message to somebody.

    When a hook is called, the run is settled: what the device was asked for is done, `trainer.metrics` are those of the
    present iteration, and the hook may change whatever it likes. CUDA graphs keep the numbers that they were captured
    with, so a change reaches them only through the tensors that they read: `copy_` into those. Example:

        class Annealing(Hook):
            interval = 10

            def __call__(self, trainer):
                for group in trainer.update.optimizer.param_groups:
                    group["lr"].mul_(0.9)

    Attributes:
        interval: iterations between calls; 0 is only at the end. Before a call the host waits for the device, so on a
            GPU an interval of 1 keeps an iteration from starting while the metrics of the last one are written.
    """

    interval: int = 1

    def __call__(self, trainer: Run) -> None:
        """Act after the iterations whose number `interval` divides."""

    def at_end(self, trainer: Run) -> None:
        """Act once after the last iteration, also of an interrupted run."""

    def state_dict(self) -> dict[str, Any]:
        """Return what later calls depend on: tensors and plain data, nested; a checkpoint keeps it."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where `state_dict` was taken."""


class EvaluationHook(Hook):
    """Judges the policy in envs of its own, and logs the figures."""

    def __init__(self, evaluator: Evaluator, *, interval: int) -> None:
        self.evaluator, self.interval = evaluator, interval
        self._evaluated_at: int | None = None

    def __call__(self, trainer: Run) -> None:
        """Evaluate, unless a signal asks to stop meanwhile."""
        with trainer.clock.paused():
            evaluation = self.evaluator(stop=trainer.interrupt.__bool__)
        if evaluation is None:
            return
        trainer.evaluation, self._evaluated_at = evaluation, trainer.iteration
        trainer.log({f"evaluation/{name}": value for name, value in evaluation.as_dict().items()})

    def at_end(self, trainer: Run) -> None:
        """Evaluate the final policy, once."""
        if not trainer.interrupt and self._evaluated_at != trainer.iteration:
            self(trainer)


class CheckpointHook(Hook):
    """Saves everything that the next iteration depends on. A full disk costs a checkpoint, not the run."""

    def __init__(self, *, interval: int) -> None:
        self.interval = interval

    def __call__(self, trainer: Run) -> None:
        """Save, or say why not."""
        if trainer.folder is None:
            return
        try:
            trainer.save()
        except OSError as error:
            trainer.progress.note(
                f"warning: no checkpoint at iteration {trainer.iteration}: {error}; the run goes on"
            )

    def at_end(self, trainer: Run) -> None:
        """Save the end, which must not fail in silence."""
        if trainer.folder is not None and trainer.saved_at != trainer.iteration:
            try:
                trainer.save()
            except OSError as error:
                raise OSError(
                    f"{trainer.folder}: no checkpoint of the end, iteration {trainer.iteration}: {error}; make room or "
                    "let it be written, and resume the run from the last one"
                ) from error
