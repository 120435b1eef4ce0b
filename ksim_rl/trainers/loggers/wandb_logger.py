"""This module writes runs to Weights & Biases, through TorchRL's `WandbLogger`."""

import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl.record.loggers.wandb import WandbLogger

from ksim_rl.trainers.loggers.metric_logger import MetricLogger


@dataclass(frozen=True, kw_only=True)
class WandbCfg:
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
