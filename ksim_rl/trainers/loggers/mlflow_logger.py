"""This module writes runs to MLflow, through TorchRL's `MLFlowLogger`."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl.record.loggers.mlflow import MLFlowLogger

from ksim_rl.trainers.loggers.metric_logger import MetricLogger

# What MLflow takes in one request, and how long a value may be.
_MAX_PARAMS, _MAX_LETTERS = 100, 6000


@dataclass(frozen=True, kw_only=True)
class MLflowCfg:
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
