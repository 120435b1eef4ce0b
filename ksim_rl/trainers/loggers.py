"""Metrics go to loggers. Any of TorchRL's fits: all that is called is `log_metrics` and `close`."""

import importlib.util
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from torchrl.record.loggers import TensorboardLogger
from torchrl.record.loggers.mlflow import MLFlowLogger
from torchrl.record.loggers.wandb import WandbLogger

from ksim_rl.checked import Checked
from ksim_rl.trainers.csv_table import CsvTable

# What MLflow takes in one request, and how long a value may be.
_MAX_PARAMS, _MAX_LETTERS = 100, 6000


class MetricLogger(Protocol):
    """The part of TorchRL's `Logger` that the trainer uses."""

    def log_metrics(self, metrics: dict[str, float], step: int) -> Any:
        """Record metrics at `step`, the number of env states so far."""

    def close(self) -> None:
        """Write out what is buffered and release the files."""


@dataclass(frozen=True, kw_only=True)
class WandbCfg(Checked):
    """A run on Weights & Biases.

    Attributes:
        project: that it belongs to.
        entity: user or team; None is the default of the account.
        name: of the run; None is that of the run folder.
        tags: to find it by.
        offline: write it into the run folder only; `wandb sync RUN/wandb/offline-*` sends it later.
    """

    project: str = "ksim_rl"
    entity: str | None = None
    name: str | None = None
    tags: tuple[str, ...] = ()
    offline: bool = False

    def __post_init__(self) -> None:
        """Refuse a project without a name."""
        super().__post_init__()
        if not self.project:
            raise ValueError(f"project={self.project!r}: expected a name")


def open_wandb(cfg: WandbCfg, run_folder: Path, config: Mapping[str, Any]) -> MetricLogger:
    """Begin the run with the config of a training run, or continue that of a resumed one."""
    logger = WandbLogger(
        cfg.name or run_folder.name,
        save_dir=run_folder,
        id=_run_id(run_folder / "wandb" / "run_id"),
        project=cfg.project,
        entity=cfg.entity,
        tags=list(cfg.tags),
        mode="offline" if cfg.offline else None,
        log_env_packages=False,
    )
    logger.log_hparams(dict(config))
    return logger


def _run_id(path: Path) -> str:
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(uuid.uuid4().hex)
    return path.read_text()


@dataclass(frozen=True, kw_only=True)
class MLflowCfg(Checked):
    """A run in MLflow.

    Attributes:
        experiment: that it belongs to.
        name: of the run; None is that of the run folder.
        tracking_uri: of the server or database; None is `MLFLOW_TRACKING_URI`, and without that variable a database
            in the run folder: `mlflow ui --backend-store-uri sqlite:///RUN/mlflow/mlflow.db` shows it.
    """

    experiment: str = "ksim_rl"
    name: str | None = None
    tracking_uri: str | None = None

    def __post_init__(self) -> None:
        """Refuse an experiment without a name."""
        super().__post_init__()
        if not self.experiment:
            raise ValueError(f"experiment={self.experiment!r}: expected a name")


class _Run(MLFlowLogger):
    """TorchRL's logger, which leaves the run open when it is closed."""

    def close(self, timeout: float | None = None) -> None:
        import mlflow  # pyright: ignore[reportMissingImports]

        mlflow.end_run()
        super().close(timeout)


def open_mlflow(cfg: MLflowCfg, run_folder: Path, config: Mapping[str, Any]) -> MetricLogger:
    """Begin the run with the config of a training run, or continue that of a resumed one."""
    import mlflow  # pyright: ignore[reportMissingImports]

    folder = run_folder / "mlflow"
    folder.mkdir(parents=True, exist_ok=True)
    kept_id = folder / "run_id"
    resumes = kept_id.exists()
    if resumes:
        # `mlflow.start_run`, which the logger calls without one, takes the id from here.
        os.environ["MLFLOW_RUN_ID"] = kept_id.read_text()
    own = f"sqlite:///{(folder / 'mlflow.db').resolve()}"
    uri = cfg.tracking_uri or os.environ.get("MLFLOW_TRACKING_URI") or own
    artifacts = (folder / "artifacts").resolve().as_uri() if uri == own else None
    logger = _Run(cfg.experiment, uri, artifact_location=artifacts)
    if not resumes:
        kept_id.write_text(logger.experiment.info.run_id)
        mlflow.set_tag("mlflow.runName", cfg.name or run_folder.name)
        params = list(_flat(config))
        for first in range(0, len(params), _MAX_PARAMS):
            mlflow.log_params(dict(params[first : first + _MAX_PARAMS]))
    return logger


def _flat(tree: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, str]]:
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", str(value)[:_MAX_LETTERS]


@dataclass(frozen=True, kw_only=True)
class LoggerCfg(Checked):
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
