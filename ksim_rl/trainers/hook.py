"""What a run does beside learning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ksim_rl.trainers.trainer import Trainer


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

    def __call__(self, trainer: Trainer) -> None:
        """Act after the iterations whose number `interval` divides."""

    def at_end(self, trainer: Trainer) -> None:
        """Act once after the last iteration, also of an interrupted run."""

    def state_dict(self) -> dict[str, Any]:
        """Return what later calls depend on: tensors and plain data, nested; a checkpoint keeps it."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where `state_dict` was taken."""
