"""`ksim-rl train`: Hydra composes the config, the trainers do the rest."""

import dataclasses
import os
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from ksim_rl import conf
from ksim_rl.cli.command_line import check_command_line
from ksim_rl.cli.report import run_and_report
from ksim_rl.trainers import RunCfg


def train(arguments: list[str]) -> int:
    """Run `ksim-rl train <arguments>` and return its exit code.

    Raises:
        ValueError: for a group, name, field or value that is wrong; nothing was built or written then.
    """
    conf.register()
    flags = get_args_parser().parse_args(arguments)
    own_config = flags.config_name or flags.config_dir or flags.config_path
    if not (flags.help or flags.hydra_help or flags.shell_completion or own_config):
        builds = flags.cfg is None and flags.info is None
        check_command_line(flags.overrides, multirun=flags.multirun or not builds, values=builds)

    codes: list[int] = []

    @hydra.main(config_path=f"pkg://{conf.MODULE}", config_name=conf.NAME, version_base="1.3")
    def job(config: DictConfig) -> None:
        codes.append(_train_one(config))
        if codes[-1] >= 128:  # interrupted: the other jobs of a multirun must not start
            sys.exit(codes[-1])

    # Hydra prints errors in its own way unless this is set; here they go to `ksim_rl.cli.main`.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    sys.argv = ["ksim-rl train", *arguments]
    job()
    return max(codes, default=0)


def _train_one(config: DictConfig) -> int:
    plain: Any = OmegaConf.to_container(config, resolve=True)
    cfg = RunCfg.from_tree(plain)
    cfg = dataclasses.replace(cfg, device=str(cfg.resolved_device()))
    return run_and_report(cfg, _unused(Path(HydraConfig.get().runtime.output_dir)))


def _unused(folder: Path) -> Path:
    """Return `folder`, or one beside it where a run that began in the same second has it already."""
    candidate, number = folder, 1
    while (candidate / "config.yaml").exists():
        number += 1
        candidate = folder.with_name(f"{folder.name}_{number}")
    return candidate
