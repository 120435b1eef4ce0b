"""`ksim-rl train`: Hydra composes the config, the trainers do the rest."""

import argparse
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
    name, own_config = _primary_config(flags)
    if not (flags.help or flags.hydra_help or flags.shell_completion or own_config):
        builds = flags.cfg is None and flags.info is None
        multirun = flags.multirun or not builds
        check_command_line(flags.overrides, name=name, multirun=multirun, values=builds)

    codes: list[int] = []
    errors: list[Exception] = []
    process = os.getpid()

    @hydra.main(config_path=f"pkg://{conf.MODULE}", config_name=name, version_base="1.3")
    def job(config: DictConfig) -> None:
        try:
            codes.append(_train_one(config))
        except Exception as error:
            if os.getpid() != process:  # some launchers run jobs elsewhere; only Hydra can bring it here then
                raise
            # Kept from Hydra, which would print a line of its own about it.
            errors.append(error)
            return
        if codes[-1] >= 128:  # interrupted: the other jobs of a multirun must not start
            sys.exit(codes[-1])

    # Hydra prints errors in its own way unless this is set; here they go to `ksim_rl.cli.main`.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    sys.argv = ["ksim-rl train", *arguments]
    job()
    if errors:
        raise errors[0]
    return max(codes, default=0)


def _primary_config(flags: argparse.Namespace) -> tuple[str, bool]:
    """Return the name of the config to compose, and whether the user brings configs that only Hydra can check."""
    if flags.config_dir and not flags.config_name and conf.register_run(Path(flags.config_dir)):
        return conf.RUN_AGAIN, False
    return conf.NAME, bool(flags.config_name or flags.config_dir or flags.config_path)


def _train_one(config: DictConfig) -> int:
    plain: Any = OmegaConf.to_container(config, resolve=True)
    cfg = RunCfg.from_tree(plain)
    cfg = dataclasses.replace(cfg, device=str(cfg.resolved_device()))
    if cfg.checkpoint is not None:
        # The run's own config must find it from anywhere.
        cfg = dataclasses.replace(cfg, checkpoint=str(Path(cfg.checkpoint).resolve()))
    return run_and_report(cfg, _unused(Path(HydraConfig.get().runtime.output_dir)))


def _unused(folder: Path) -> Path:
    """Return `folder`, or one beside it where a run that began in the same second has it already."""
    candidate, number = folder, 1
    while (candidate / conf.RUN_CONFIG).exists():
        number += 1
        candidate = folder.with_name(f"{folder.name}_{number}")
    return candidate
