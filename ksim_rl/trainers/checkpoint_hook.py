"""Checkpoints at an interval, and of the end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ksim_rl.trainers.hook import Hook

if TYPE_CHECKING:
    from ksim_rl.trainers.trainer import Trainer


class CheckpointHook(Hook):
    """Saves everything that the next iteration depends on. A full disk costs a checkpoint, not the run."""

    def __init__(self, *, interval: int) -> None:
        self.interval = interval

    def __call__(self, trainer: Trainer) -> None:
        """Save, or say why not."""
        if trainer.folder is None:
            return
        try:
            trainer.save()
        except OSError as error:
            trainer.progress.note(
                f"warning: no checkpoint at iteration {trainer.iteration}: {error}; the run goes on"
            )

    def at_end(self, trainer: Trainer) -> None:
        """Save the end, which must not fail in silence."""
        if trainer.folder is not None and trainer.saved_at != trainer.iteration:
            try:
                trainer.save()
            except OSError as error:
                raise OSError(
                    f"{trainer.folder}: no checkpoint of the end, iteration {trainer.iteration}: {error}; make room or "
                    "let it be written, and resume the run from the last one"
                ) from error
