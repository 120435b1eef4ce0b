"""The trainer asks no more of a logger than this protocol has."""

from typing import Any, Protocol


class MetricLogger(Protocol):
    """The part of TorchRL's `Logger` that the trainer uses."""

    def log_metrics(self, metrics: dict[str, float], step: int) -> Any:
        """Record metrics at `step`, the number of env states so far."""

    def close(self) -> None:
        """Write out what is buffered and release the files."""
