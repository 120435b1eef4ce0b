"""Trains for a command, and prints how the run went."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from ksim_rl import envs, ranks
from ksim_rl.cli.errors import interruption
from ksim_rl.device.kernel_loading import compile_notice
from ksim_rl.diagnosis.diagnose import one_line
from ksim_rl.export.lacks import say_lacks
from ksim_rl.terminal import printable
from ksim_rl.trainers import (
    Checkpoint,
    Evaluation,
    Outcome,
    RunCfg,
    RunProgress,
    TrainingCfg,
    checkpoint,
    run,
)
from ksim_rl.trainers.build import solved_at
from ksim_rl.viewer.live_training import watched

# By so much a rollout length may differ from the task's own before a run says so.
FAR = 4


def run_and_report(cfg: RunCfg, folder: Path, *, resume_from: Checkpoint | None = None) -> int:
    """Train with progress on the terminal, say how it ended, and return the exit code."""
    # All ranks write into the folder of rank 0.
    folder = Path(ranks.run_folder(str(folder)))
    # torchrun starts all ranks again after a fault: go on from the last checkpoint.
    if ranks.restarted() and checkpoint.saved(folder / "checkpoint"):
        resume_from = checkpoint.load_latest(folder)
    if resume_from is None:
        done = 0
    else:
        done = resume_from.iteration
    progress = RunProgress(cfg.trainer.num_iterations, done=done)
    length = cfg.data.rollout_length(cfg.num_envs)
    each = cfg.num_envs * length
    size = ranks.size()
    if size > 1:
        all_ranks = f" on each of {size} ranks, {cfg.num_envs * size} envs and {each * size} in all"
    else:
        all_ranks = ""
    progress.note(
        f"{cfg.task_name}: {cfg.num_envs} envs x {length} steps = {each} env states per iteration{all_ranks}, "
        f"on {cfg.device}; run folder {shown(folder)}"
    )
    # A rollout far from the tuned one is often a forgotten setting after a change of num_envs.
    if own := _far_from(cfg, length):
        progress.note(
            f"rollouts of {length} steps are far from the {own}: collector.rollout_length keeps to that"
        )
    try:
        # `watched` shows the training in a browser, where the config asks for it.
        with compile_notice(progress.status), watched(cfg, progress.note) as hooks:
            outcome = run(
                cfg,
                folder,
                progress=progress,
                hooks=hooks,
                resume_from=resume_from,
                # Before the first iteration, when a term can still be changed.
                before=lambda trainer: say_lacks(cfg, trainer.collector.env, progress.note),
            )
    except KeyboardInterrupt as stopped:
        number = interruption(stopped)
        progress.note(f"{number.name}: {_what_is_saved(folder)}")
        # The code that shells give to a program that a signal ended.
        return 128 + int(number)
    if cfg.logger.wandb is not None and not ranks.rank():
        from ksim_rl.zoo.wandb_runs import upload  # it writes ONNX files, which most runs do not

        upload(cfg.logger.wandb, folder, note=progress.note)
    # One rank speaks for all.
    for line in () if ranks.rank() else _summary(cfg, outcome, folder):
        progress.note(line)
    if outcome.interrupted_by is not None:
        return 128 + int(outcome.interrupted_by)
    # `stop_at` is the user's own aim, so it counts before the threshold of the task.
    if outcome.target_met is None:
        reached = outcome.solved
    else:
        reached = outcome.target_met
    # None means that there was nothing to reach.
    return 1 if reached is False else 0


def _what_is_saved(folder: Path) -> str:
    if saved := checkpoint.saved(folder / "checkpoint"):
        return f"saved are the checkpoints up to {saved[-1].name}; continue with: ksim-rl resume {shown(folder)}"
    if folder.exists():
        return f"no checkpoint is saved yet; start over with: ksim-rl train --config-dir {shown(folder)}"
    return "nothing is saved, and no folder is left"


@contextmanager
def shown_working(text: str) -> Iterator[RunProgress]:
    """Show on stderr that a command works, and the kernels it compiles, while it says nothing else."""
    progress = RunProgress(1, console=Console(stderr=True, highlight=False))
    with compile_notice(progress.status), progress.busy(text):
        yield progress


def verdict(evaluation: Evaluation, threshold: float | None) -> str:
    """Say how good an evaluation is, against the threshold of the task if it has one."""
    text = (
        f"evaluation over {evaluation.episodes} episodes (deterministic, fresh envs): return "
        f"{evaluation.return_mean:.1f} +- {evaluation.return_std:.1f}, length {evaluation.length_mean:.0f} steps"
    )
    if evaluation.unfinished:
        text += f" ({evaluation.unfinished} cut at the step limit)"
    if threshold is None:
        return text
    solved = evaluation.return_mean >= threshold
    return f"{text}: {'SOLVED' if solved else 'NOT SOLVED'} (threshold {threshold:g})"


def shown(path: Path) -> str:
    """Return a path as short as it can be written from here, and in one line."""
    # A path of many ".." is harder to read than the absolute one.
    relative = os.path.relpath(path)
    return printable(str(path) if relative.startswith("..") else relative)


def _far_from(cfg: RunCfg, length: int) -> str:
    """Say which rollout length the task is tuned for, where a run's is very different, by the same algorithm."""
    if cfg.task_name in envs.names():
        task = envs.task(cfg.task_name)
    else:
        task = None
    if task is None:
        trainings = []
    else:
        trainings = [task.training, *task.other_trainings]
    for training in trainings:
        # Another algorithm has other rollouts: nothing to compare with.
        if isinstance(training, TrainingCfg) and type(training.objective) is type(cfg.objective):
            own = training.data.rollout_length(training.num_envs)
            if not own / FAR <= length <= own * FAR:
                return f"{own} that {cfg.task_name} is tuned for, with {training.num_envs} envs"
    return ""


def _summary(cfg: RunCfg, outcome: Outcome, folder: Path) -> list[str]:
    if outcome.seconds:
        speed = outcome.env_states / outcome.seconds
    else:
        speed = 0.0
    lines = [
        f"{outcome.iteration} iterations, {outcome.env_states:,} env states in {outcome.seconds:.0f} s "
        f"({speed:,.0f} per s, evaluations included)"
    ]
    if outcome.target_met is not None:
        targets = ", ".join(
            f"{name} >= {value:g}" for name, value in (cfg.trainer.stop_at or {}).items()
        )
        lines.append(f"stop_at {'MET' if outcome.target_met else 'NOT MET'}: {targets}")
    if outcome.interrupted_by is not None:
        name = outcome.interrupted_by.name
        lines.append(f"{name}: everything is saved; continue with: ksim-rl resume {shown(folder)}")
    elif outcome.evaluation is not None:
        lines.append(verdict(outcome.evaluation, solved_at(cfg)))
    # Only faults that were found: nothing is said of a healthy run.
    if (seen := one_line(folder, shown(folder))).startswith("diagnosis"):
        lines.append(seen)
    lines.append(f"{shown(folder)}: {', '.join(sorted(entry.name for entry in folder.iterdir()))}")
    return lines
