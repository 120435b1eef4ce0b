"""`ksim-rl train` lets Hydra compose the config, and trains with it."""

import argparse
import dataclasses
import os
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ksim_rl import conf
from ksim_rl.cli.command_line import check_command_line
from ksim_rl.cli.errors import report
from ksim_rl.cli.report import run_and_report
from ksim_rl.cli.upstream import parse_flags
from ksim_rl.config import plugins
from ksim_rl.trainers import RunCfg


def train(arguments: list[str]) -> int:
    """Run `ksim-rl train <arguments>` and return its exit code, the highest of all jobs of a multirun.

    A job that fails says why; the others still run.

    Raises:
        ValueError: for a group, name, field or value that is wrong; nothing was built or written then.
    """
    conf.register()
    flags = parse_flags(arguments)
    name, own_config = _primary_config(flags)
    if not (flags.help or flags.hydra_help or flags.shell_completion or own_config):
        builds = flags.cfg is None and flags.info is None
        multirun = flags.multirun or not builds
        check_command_line(flags.overrides, name=name, multirun=multirun, values=builds)

    codes: list[int] = []
    process = os.getpid()

    @hydra.main(config_path=f"pkg://{conf.MODULE}", config_name=name, version_base="1.3")
    def job(config: DictConfig) -> None:
        try:
            codes.append(_train_one(config))
        except Exception as error:
            if os.getpid() != process:  # some launchers run jobs elsewhere; only Hydra can bring it here then
                raise
            # Kept from Hydra, which would print a line of its own about it and start no other job.
            codes.append(report(error, about=_job_of_a_multirun()))
        if codes[-1] >= 128:  # interrupted: the other jobs of a multirun must not start
            sys.exit(codes[-1])

    # Hydra prints errors in its own way unless this is set; here they go to `ksim_rl.cli.main`.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    sys.argv = ["ksim-rl train", *arguments]
    try:
        job()
    except HydraException as error:  # all that is left for Hydra to find, such as another --config-name
        raise ValueError(str(error)) from error
    return max(codes, default=0)


def _primary_config(flags: argparse.Namespace) -> tuple[str, bool]:
    """Return the name of the config to compose, and whether the user brings configs that only Hydra can check."""
    if flags.config_dir and not flags.config_name:
        folder = Path(flags.config_dir)
        if conf.register_run(folder):
            return conf.RUN_AGAIN, False
        if all(path.name == conf.RUN_CONFIG for path in folder.glob("*/**/*.yaml")):
            # Nothing here is in a group, so Hydra would go on as if the folder had not been named.
            raise ValueError(
                f"--config-dir {folder}: expected a run folder, which has the {conf.RUN_CONFIG} of a run, or a folder "
                "with config groups of yours"
            )
    return conf.NAME, bool(flags.config_name or flags.config_dir or flags.config_path)


def _job_of_a_multirun() -> str:
    """Return which job this is, for a message; nothing for a run of its own."""
    launched = HydraConfig.get()
    if launched.mode != RunMode.MULTIRUN:
        return ""
    return f"job {launched.job.num} ({', '.join(launched.overrides.task)}): "


def _train_one(config: DictConfig) -> int:
    plugins.load(())  # those of the environment, where a launcher runs the job in a process of its own
    plain: Any = OmegaConf.to_container(config, resolve=True)
    cfg = RunCfg.from_tree(plain)
    cfg = dataclasses.replace(cfg, device=str(cfg.resolved_device()))
    # The run's own config must find what it names from anywhere.
    if cfg.checkpoint is not None:
        cfg = dataclasses.replace(cfg, checkpoint=str(Path(cfg.checkpoint).resolve()))
    cfg = dataclasses.replace(cfg, objective=cfg.objective.with_absolute_paths())
    return run_and_report(cfg, _unused(Path(HydraConfig.get().runtime.output_dir)))


def _unused(folder: Path) -> Path:
    """Return `folder`, or one beside it where a run that began in the same second has it already."""
    candidate, number = folder, 1
    while (candidate / conf.RUN_CONFIG).exists():
        number += 1
        candidate = folder.with_name(f"{folder.name}_{number}")
    return candidate
