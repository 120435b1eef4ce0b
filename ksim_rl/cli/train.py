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
from ksim_rl.checks import near
from ksim_rl.cli.command_line import check_command_line
from ksim_rl.physics import compile_notice
from ksim_rl.trainers import Outcome, RunCfg, RunProgress, run


def train(arguments: list[str]) -> int:
    """Run `ksim-rl train <arguments>` and return its exit code.

    Raises:
        ValueError: for a group, name, field or value that is wrong; nothing was built or written then.
    """
    conf.register()
    flags = get_args_parser().parse_args(arguments)
    own_config = flags.config_name or flags.config_dir or flags.config_path
    if not (flags.help or flags.hydra_help or flags.shell_completion or own_config):
        check_command_line(flags.overrides, values=flags.cfg is None and flags.info is None)

    codes: list[int] = []

    @hydra.main(config_path=f"pkg://{conf.MODULE}", config_name=conf.NAME, version_base="1.3")
    def job(config: DictConfig) -> None:
        code = _train_one(config)
        codes.append(code)
        if code >= 128:  # interrupted: the other jobs of a multirun must not start
            sys.exit(code)

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


def run_and_report(cfg: RunCfg, folder: Path, **options: Any) -> int:
    """Train with progress on the terminal, say how it ended, and return the exit code."""
    done = options["resume_from"].iteration if options else 0
    progress = RunProgress(cfg.trainer.num_iterations, done=done)
    length = cfg.data.rollout_length(cfg.num_envs)
    progress.note(
        f"{cfg.task_name}: {cfg.num_envs} envs x {length} steps = {cfg.data.num_env_states} env states per iteration, "
        f"on {cfg.device}; run folder {_shown(folder)}"
    )
    with compile_notice(progress.status):
        outcome = run(cfg, folder, progress=progress, **options)
    progress.note(summary(outcome, folder))
    if outcome.interrupted_by is not None:
        return 128 + int(outcome.interrupted_by)
    return 1 if outcome.solved is False else 0


def summary(outcome: Outcome, folder: Path) -> str:
    """Say in a few lines how a run ended."""
    speed = outcome.env_states / outcome.seconds if outcome.seconds else 0.0
    lines = [
        f"{outcome.iteration} iterations, {outcome.env_states:,} env states in {outcome.seconds:.0f} s "
        f"({speed:,.0f} per s, evaluations included)"
    ]
    if outcome.interrupted_by is not None:
        lines.append(f"{outcome.interrupted_by.name}: saved; continue with: ksim-rl resume {_shown(folder)}")
    elif outcome.evaluation is not None:
        lines.append(verdict(outcome.evaluation.return_mean, outcome.evaluation.return_std, outcome))
    lines.append(f"run folder {_shown(folder)}: {', '.join(sorted(entry.name for entry in folder.iterdir()))}")
    return "\n".join(lines)
