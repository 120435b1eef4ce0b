"""This module opens the loggers that a run's config asks for."""

import importlib.util
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl.record.loggers import TensorboardLogger

from ksim_rl.trainers.loggers.csv_table import CsvTable
from ksim_rl.trainers.loggers.metric_logger import MetricLogger
from ksim_rl.trainers.loggers.mlflow_logger import MLflowCfg, open_mlflow
from ksim_rl.trainers.loggers.wandb_logger import WandbCfg, open_wandb


@dataclass(frozen=True, kw_only=True)
class LoggerCfg:
    """Where metrics are written; files lie in the run folder.

    Attributes:
        csv: one table, `metrics.csv`; the learning curves are drawn from it.
        tensorboard: event files in `tensorboard/`.
        wandb: a run on Weights & Biases (needs `ksim_rl[wandb]`); None has none.
        mlflow: a run in MLflow (needs `ksim_rl[mlflow]`); None has none.
    """

    csv: bool = True
    tensorboard: bool = True
    wandb: WandbCfg | None = None
    mlflow: MLflowCfg | None = None


def check_installed(cfg: LoggerCfg) -> None:
    """Refuse loggers whose packages are missing.

    Raises:
        ValueError: with the command that installs the package.
    """
    for name in ("wandb", "mlflow"):
        if getattr(cfg, name) is not None and importlib.util.find_spec(name) is None:
            raise ValueError(f"logger.{name}: the package {name} is missing: pip install 'ksim_rl[{name}]'")


def make_loggers(
    cfg: LoggerCfg, run_folder: Path, *, config: Mapping[str, Any] | None = None
) -> list[MetricLogger]:
    """Open the loggers of a run; those that show a run's config get `config`, plain data.

    Raises:
        RuntimeError: if a service is not there, or does not know the user.
    """
    loggers: list[MetricLogger] = []
    if cfg.csv:
        loggers.append(CsvTable(run_folder / "metrics.csv"))
    if cfg.tensorboard:
        loggers.append(TensorboardLogger("tensorboard", log_dir=str(run_folder)))
    if cfg.wandb is not None:
        with _service("wandb", "log in, or set logger.wandb.offline=true"):
            loggers.append(open_wandb(cfg.wandb, run_folder, config or {}))
    if cfg.mlflow is not None:
        with _service("mlflow", "see to the server, or set logger.mlflow.tracking_uri"):
            loggers.append(open_mlflow(cfg.mlflow, run_folder, config or {}))
    return loggers


@contextmanager
def _service(name: str, fix: str) -> Iterator[None]:
    """Turn what a service raises, which has types of its own, into an error that names the logger and the fix."""
    try:
        yield
    except Exception as error:
        raise RuntimeError(f"logger.{name} cannot begin a run ({fix}): {error}") from error
