"""Which loggers a run has."""

from dataclasses import dataclass
from pathlib import Path

from torchrl.record.loggers import TensorboardLogger

from ksim_rl.trainers.loggers.csv_table import CsvTable
from ksim_rl.trainers.loggers.metric_logger import MetricLogger


@dataclass(frozen=True, kw_only=True)
class LoggerCfg:
    """Where metrics are written, inside the run folder.

    Attributes:
        csv: one table, `metrics.csv`; the learning curves are drawn from it.
        tensorboard: event files in `tensorboard/`.
    """

    csv: bool = True
    tensorboard: bool = True


def make_loggers(cfg: LoggerCfg, run_folder: Path) -> list[MetricLogger]:
    """Open the loggers of a run."""
    loggers: list[MetricLogger] = []
    if cfg.csv:
        loggers.append(CsvTable(run_folder / "metrics.csv"))
    if cfg.tensorboard:
        loggers.append(TensorboardLogger("tensorboard", log_dir=str(run_folder)))
    return loggers
