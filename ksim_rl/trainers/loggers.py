"""Opens the loggers of metrics. Any of TorchRL's fits: only `log_metrics` and `close` are called."""

import importlib.util
import os
import re
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from torchrl.record.loggers import TensorboardLogger
from torchrl.record.loggers.mlflow import MLFlowLogger
from torchrl.record.loggers.wandb import WandbLogger

from ksim_rl.checked import Checked, Name
from ksim_rl.config import plain_data
from ksim_rl.config.trees import Tree
from ksim_rl.files.reading import read_bytes
from ksim_rl.files.writing import make_folder, write_whole
from ksim_rl.runs.csv_table import CsvTable
from ksim_rl.runs.listing import METRICS

# MLflow's limits: entries of one request, and letters of a value.
_MAX_PARAMS = 100
_MAX_LETTERS = 6000


class MetricLogger(Protocol):
    """The part of TorchRL's `Logger` that the trainer uses."""

    def log_metrics(self, metrics: dict[str, float], step: int) -> Any:
        """Record metrics at `step`, the number of env states so far."""

    def close(self) -> None:
        """Write out buffered metrics and release the files."""


@dataclass(frozen=True, kw_only=True)
class WandbCfg(Checked):
    """A run on Weights & Biases; by default of the account's entity, with the name of the run folder."""

    project: Name = "ksim_rl"
    entity: str | None = None
    name: str | None = None
    tags: tuple[str, ...] = ()
    offline: bool = False  # write into the run folder only, for `wandb sync` later


def open_wandb(cfg: WandbCfg, run_folder: Path, config: Tree) -> MetricLogger:
    """Begin the run with the config of a training run, or continue a resumed run's."""
    path = run_folder / "wandb" / "run_id"
    # The id stays in the folder, so that a resumed run goes on in the same place.
    if not path.exists():
        make_folder(path.parent, below=run_folder)
        write_whole(path, uuid.uuid4().hex)
    logger = WandbLogger(
        cfg.name or run_folder.name,
        save_dir=run_folder,
        id=kept_id(run_folder),
        project=cfg.project,
        entity=cfg.entity,
        tags=list(cfg.tags),
        mode="offline" if cfg.offline else None,
        log_env_packages=False,
    )
    logger.log_hparams(dict(config))
    return logger


def kept_id(run_folder: Path, logger: str = "wandb") -> str:
    """Return the id that a run folder keeps of its run elsewhere, which becomes part of paths and addresses."""
    path = run_folder / logger / "run_id"
    # Few bytes and plain letters, as the id becomes part of paths and addresses.
    text = read_bytes(path, limit=100).decode(errors="replace")
    if not re.fullmatch(r"[\w-]+", text, re.ASCII):
        raise ValueError(f"{path}: {text!r} is not the id of a run: letters, digits, _ and -")
    return text


@dataclass(frozen=True, kw_only=True)
class MLflowCfg(Checked):
    """A run in MLflow, by default with the name of the run folder.

    The server or database `tracking_uri` is by default `MLFLOW_TRACKING_URI`, and without that variable a database in
    the run folder: `mlflow ui --backend-store-uri sqlite:///RUN/mlflow/mlflow.db` shows it.
    """

    experiment: Name = "ksim_rl"
    name: str | None = None
    tracking_uri: str | None = None


class _Run(MLFlowLogger):
    """TorchRL's logger, which leaves the run open when it is closed."""

    def close(self, timeout: float | None = None) -> None:
        import mlflow  # pyright: ignore[reportMissingImports]

        mlflow.end_run()
        super().close(timeout)


def open_mlflow(cfg: MLflowCfg, run_folder: Path, config: Tree) -> MetricLogger:
    """Begin the run with the config of a training run, or continue a resumed run's."""
    import mlflow  # pyright: ignore[reportMissingImports]

    folder = run_folder / "mlflow"
    make_folder(folder, below=run_folder)
    path = folder / "run_id"
    resumes = path.exists()
    if resumes:
        # `mlflow.start_run`, which the logger calls without one, takes the id from here.
        os.environ["MLFLOW_RUN_ID"] = kept_id(run_folder, "mlflow")
    own = f"sqlite:///{(folder / 'mlflow.db').resolve()}"
    uri = cfg.tracking_uri or os.environ.get("MLFLOW_TRACKING_URI") or own
    # A database in the run folder keeps its artifacts there, too; a server has a place of its own.
    if uri == own:
        artifacts = (folder / "artifacts").resolve().as_uri()
    else:
        artifacts = None
    logger = _Run(cfg.experiment, uri, artifact_location=artifacts)
    if not resumes:
        write_whole(path, logger.experiment.info.run_id)
        mlflow.set_tag("mlflow.runName", cfg.name or run_folder.name)
        params = [(name, str(value)[:_MAX_LETTERS]) for name, value in plain_data.flat(config)]
        # In pieces, as the server refuses longer requests.
        for first in range(0, len(params), _MAX_PARAMS):
            mlflow.log_params(dict(params[first : first + _MAX_PARAMS]))
    return logger


@dataclass(frozen=True, kw_only=True)
class LoggerCfg(Checked):
    """Where metrics are written; files lie in the run folder."""

    csv: bool = True  # one table, `metrics.csv`; the learning curves are drawn from it
    tensorboard: bool = True  # event files in `tensorboard/`
    wandb: WandbCfg | None = None  # needs `ksim_rl[wandb]`
    mlflow: MLflowCfg | None = None  # needs `ksim_rl[mlflow]`


def check_installed(cfg: LoggerCfg) -> None:
    """Refuse loggers whose packages are missing, with the command that installs the package."""
    for name in ("wandb", "mlflow"):
        if getattr(cfg, name) is not None and importlib.util.find_spec(name) is None:
            raise ValueError(
                f"logger.{name}: the package {name} is missing: pip install 'ksim_rl[{name}]'"
            )


def make_loggers(
    cfg: LoggerCfg, run_folder: Path, *, config: Tree | None = None
) -> list[MetricLogger]:
    """Open the loggers of a run, some of them show its `config`; a RuntimeError names a service that refuses."""
    loggers: list[MetricLogger] = []
    if cfg.csv:
        loggers.append(CsvTable(run_folder / METRICS))
    if cfg.tensorboard:
        loggers.append(TensorboardLogger("tensorboard", log_dir=str(run_folder)))
    services: dict[str, tuple[Callable[..., MetricLogger], str]] = {
        "wandb": (open_wandb, "log in, or set logger.wandb.offline=true"),
        "mlflow": (open_mlflow, "see to the server, or set logger.mlflow.tracking_uri"),
    }
    for name, (begin, fix) in services.items():
        # Services last: they talk to a server, and may refuse.
        if (service := getattr(cfg, name)) is not None:
            try:
                loggers.append(begin(service, run_folder, config or {}))
            except Exception as error:  # each service has types of its own
                raise RuntimeError(f"logger.{name} cannot begin a run ({fix}): {error}") from error
    return loggers
