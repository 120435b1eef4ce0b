"""`ksim-rl train` lets Hydra compose the config, and trains with it."""

import argparse
import dataclasses
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ksim_rl import conf, ranks
from ksim_rl.cli.errors import report, say
from ksim_rl.cli.report import run_and_report
from ksim_rl.cli.upstream import parse_flags
from ksim_rl.config import plugins
from ksim_rl.data import ReplayCfg
from ksim_rl.files.writing import check_links, check_place
from ksim_rl.runs.run_lock import is_locked
from ksim_rl.terminal import show
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.kept_models import with_kept_models
from ksim_rl.trainers.run_cfg import reaching_outside
from ksim_rl.trainers.run_folder import FOLDERS
from ksim_rl.trainers.sources import check_sources


def train(arguments: list[str]) -> int:
    """Run `ksim-rl train <arguments>` and return its exit code, the highest of all jobs of a multirun.

    A job that fails says why; the others still run. A ValueError names a group, name, field or value that is wrong;
    nothing was built or written then.
    """
    # Groups and classes go into Hydra's store before it composes anything.
    conf.register()
    arguments = [conf.spelling.in_full(word) for word in arguments]
    flags, unknown = parse_flags(arguments)
    if unknown:
        raise conf.spelling.of_flag(unknown[0], arguments)
    if flags.shell_completion:
        raise ValueError(
            "--shell-completion is Hydra's, and knows programs of one word: ksim-rl completion bash prints a script "
            "that completes ksim-rl"
        )
    name, own_config = _primary_config(flags)
    if flags.help and name == conf.NAME and not own_config:
        show(conf.help_page(flags.overrides))
        return 0
    if name == conf.RUN_AGAIN:
        began = Path(flags.config_dir)
    else:
        began = None
    # A config of the user's own is not known before Hydra reads it.
    if not (flags.help or flags.hydra_help or flags.shell_completion or own_config):
        builds = flags.cfg is None and flags.info is None
        multirun = flags.multirun or not builds
        for cfg in conf.check_command_line(
            flags.overrides, name=name, multirun=multirun, values=builds
        ):
            check_sources(_with_models_of(began, cfg, note=lambda _: None))

    # Checked now, since Hydra composes each job of a multirun on its own.
    groups = _folders_of_groups(flags, own_config)
    given = conf.fields_of(flags.overrides)
    codes: list[int] = []
    process = os.getpid()
    own_command = sys.argv

    @hydra.main(config_path=f"pkg://{conf.MODULE}", config_name=name, version_base="1.3")
    def job(config: DictConfig) -> None:
        sys.argv = own_command  # which the run's folder keeps
        try:
            codes.append(_train_one(config, groups, given, began))
        except Exception as error:
            # Some launchers run jobs elsewhere; only Hydra can bring it here then.
            if os.getpid() != process:
                raise
            # Kept from Hydra, which would print a line of its own about it and start no other job.
            codes.append(report(error, about=_job_of_a_multirun()))
            _remove_empty(Path(HydraConfig.get().runtime.output_dir))
        if codes[-1] >= 128:  # interrupted: the other jobs of a multirun must not start
            sys.exit(codes[-1])

    # Hydra prints errors in its own way unless this is set; here they go to `ksim_rl.cli.main`.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    # A run folder is data: Hydra must not look for configs in it. The last of two folders counts.
    if name == conf.RUN_AGAIN:
        away = ["--config-dir", str(Path(conf.__file__).parent)]
    else:
        away = []
    overrides = list(flags.overrides)
    if ranks.size() > 1 and flags.multirun:
        raise ValueError(
            "--multirun starts several runs, and torchrun several ranks of one: use one of the two"
        )
    if ranks.rank():  # rank 0 has the run's folder
        overrides.append(f"hydra.run.dir={tempfile.mkdtemp(prefix='ksim-rl-rank-')}")
    if flags.multirun:  # jobs are named by their differences
        same = ",".join(f"'{key}'" for key in conf.without_sweeps(overrides))
        overrides.append(f"hydra.job.config.override_dirname.exclude_keys=[{same}]")
    # Overrides come together: Hydra takes those after a flag for faults.
    options = [text for text in arguments if text not in flags.overrides]
    for text in flags.overrides:
        field, _, folder = text.partition("=")
        # Hydra makes these folders itself; with references in them they are known to it alone.
        if field in ("hydra.run.dir", "hydra.sweep.dir") and "${" not in folder:
            check_place(field, Path(folder.strip("'\"")), is_folder=True)
    sys.argv = ["ksim-rl train", *options, *away, *overrides]
    try:
        job()
    # All that is left for Hydra to find, such as another --config-name.
    except HydraException as error:
        raise ValueError(_with_first_cause(error)) from error
    return max(codes, default=0)


def _with_first_cause(error: HydraException) -> str:
    """Return Hydra's message with its cause, such as a library that a variable of the environment breaks."""
    text = str(error)
    cause: BaseException = error
    while cause.__cause__ is not None:
        cause = cause.__cause__
    if str(cause) not in text:
        text = f"{text}: {type(cause).__name__}: {cause}"
    return text


def _primary_config(flags: argparse.Namespace) -> tuple[str, bool]:
    """Return the name of the config to compose, and whether the user brings configs that only Hydra can check."""
    for given in filter(None, (flags.config_dir, flags.config_path)):
        if (flags.config_name or flags.config_path) and os.path.lexists(
            Path(given, conf.RUN_CONFIG)
        ):
            raise ValueError(
                f"{given}: the config of a run is data and no primary config: give --config-dir {given} alone"
            )
    if flags.config_dir and not flags.config_name:
        folder = Path(flags.config_dir)
        if os.path.lexists(folder / conf.RUN_CONFIG):
            conf.register_run(folder, conf.fields_of(flags.overrides))
            return conf.RUN_AGAIN, False
        conf.check_groups(folder)
    return conf.NAME, bool(flags.config_name or flags.config_dir or flags.config_path)


def _job_of_a_multirun() -> str:
    """Return which job this is, for a message; nothing for a single run."""
    launched = HydraConfig.get()
    if launched.mode != RunMode.MULTIRUN:
        return ""
    return f"job {launched.job.num} ({', '.join(launched.overrides.task)}): "


def _folders_of_groups(flags: argparse.Namespace, own_config: bool) -> list[Path]:
    """Return the folders of groups that Hydra searches and that are not trusted, checked as the config of a run is."""
    searched = conf.searched_folders(flags.overrides)
    for folder in searched:
        conf.check_groups(folder)
    # A primary config of the user's own vouches for its folder; `_primary_config` has checked the others.
    if own_config and not flags.config_name and not flags.config_path:
        searched.append(Path(flags.config_dir))
    return searched


def _with_models_of(began: Path | None, cfg: RunCfg, *, note: Callable[[str], None]) -> RunCfg:
    """Return the config of a run that is made once more with the models that the run in folder `began` began with."""
    if began is None:
        return cfg
    return with_kept_models(cfg, began, note=note)


def _train_one(
    config: DictConfig, groups: Sequence[Path], given: Sequence[str], began: Path | None
) -> int:
    # Plug-ins of the environment, where a launcher runs the job in another process.
    plugins.load(())
    plain: Any = OmegaConf.to_container(config, resolve=True)
    for path, value in reaching_outside(plain, given=given) if groups else ():
        raise ValueError(
            f"{', '.join(map(str, groups))}: {path}={value!r} reaches outside of the run folder, and groups of a "
            f"folder may not: set {path} on the command line"
        )
    own = conf.own_files()
    with conf.naming_files(own):
        cfg = RunCfg.from_tree(plain)
    launched = HydraConfig.get()
    # A run that is made again has its own config, and what files said in it before.
    if began is None:
        conf.check_files_not_replaced(cfg, own, launched.overrides.task)
    # Only here for a config of the user's own, and for the last jobs of a long sweep.
    conf.check_composed(cfg, launched.overrides.task, again=began is not None)
    cfg = dataclasses.replace(cfg, device=str(cfg.resolved_device()))
    # The run's own config must find its files from anywhere.
    if cfg.checkpoint is not None:
        cfg = dataclasses.replace(cfg, checkpoint=str(Path(cfg.checkpoint).resolve()))
    cfg = dataclasses.replace(cfg, objective=cfg.objective.with_absolute_paths())
    if isinstance(cfg.data, ReplayCfg):
        cfg = dataclasses.replace(cfg, data=cfg.data.with_absolute_paths())
    cfg = _with_models_of(began, cfg, note=say)
    folder = Path(launched.runtime.output_dir)
    # Where the user named the folder of a run that is under way, that run's lock says so.
    named = any(
        text.startswith("hydra.run.dir=") for text in launched.overrides.hydra
    ) and is_locked(folder)
    if not named:
        folder = _unused(folder)
    if folder.is_dir():
        check_links(folder, below=FOLDERS)
    return run_and_report(cfg, folder)


def _unused(folder: Path) -> Path:
    """Return `folder`, or one beside it where a run that began in the same second has it already."""
    candidate = folder
    number = 1
    while (candidate / conf.RUN_CONFIG).exists() or is_locked(candidate):
        number += 1
        candidate = folder.with_name(f"{folder.name}_{number}")
    return candidate


def _remove_empty(folder: Path) -> None:
    """Remove the folder that Hydra made for a run which left nothing in it, and those above it in our own `runs`."""
    made = [
        folder,
        *(above for above in folder.parents if above.is_relative_to(Path.cwd() / "runs")),
    ]
    with suppress(OSError):  # as soon as there is something in one
        for empty in made:
            empty.rmdir()
