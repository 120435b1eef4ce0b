"""Checks that the checkpoints, robots and targets that a run names exist, before anything is built."""

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

from ksim_rl.checks import naming, near
from ksim_rl.data import ReplayCfg, read_episodes
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.evaluation import Evaluation
from ksim_rl.trainers.loggers import check_installed
from ksim_rl.trainers.run_cfg import RunCfg

# Of each kind that the env's terms do not name.
EPISODE = ("return", "length", "count", "non_finite")
ALWAYS = ("iteration", "seconds", "rollout/reward", "throughput/env_states_per_s")
NAMED_LATER = ("curriculum", "command", "physics")


def checkpoints_of(cfg: RunCfg) -> dict[str, str]:
    """Return the run folders and checkpoints that a config names, by the dotted paths of their fields."""
    named = {}
    if cfg.checkpoint is not None:
        named["checkpoint"] = cfg.checkpoint
    for name in cfg.objective.checkpoint_fields:
        named[f"objective.{name}"] = getattr(cfg.objective, name)
    return named


def recordings_of(cfg: RunCfg) -> dict[str, str]:
    """Return the folders of episodes that a config names, by the dotted paths of their fields."""
    named = {}
    for name in cfg.objective.episode_fields:
        named[f"objective.{name}"] = getattr(cfg.objective, name)
    if isinstance(cfg.data, ReplayCfg) and cfg.data.offline is not None:
        named["data.offline.source"] = cfg.data.offline.source
    return named


def check_sources(cfg: RunCfg, *, resumes: bool = False) -> None:
    """Refuse a run whose checkpoints, loggers' packages, robots' files or targets are not there, by a ValueError.

    Nothing is compiled or written. A run that `resumes` has its starting point in its own checkpoint.
    """
    check_installed(cfg.logger)
    for field, path in checkpoints_of(cfg).items():
        # Read as a whole, hashes included: a damaged file must fail now and not after minutes.
        if not resumes:
            with naming(f"{field}={path}", checkpoint.CheckpointError):
                checkpoint.load_latest(Path(path))
    for field, path in recordings_of(cfg).items():
        with naming(f"{field}={path}"):
            read_episodes(path)
    for kind, entities in (("robots", cfg.task.scene.robots), ("objects", cfg.task.scene.objects)):
        # Reads the model's files, without compiling them.
        for name, entity in entities.items():
            with naming(f"task.scene.{kind}.{name}", ValueError, OSError):
                entity.spec()
    check_targets(cfg)


def check_targets(cfg: RunCfg, measured: Iterable[str] | None = None) -> None:
    """Refuse names in `stop_at` that no metric will have; `measured` are the names of the algorithm's own metrics."""
    task = cfg.task
    if measured is not None:
        # Read for each name, and once more for the error.
        measured = list(measured)
    known = [*ALWAYS, *(f"episode/{name}" for name in EPISODE)]
    # A term of weight 0 is not computed.
    known += [f"reward/{name}" for name, term in task.rewards.items() if term.weight != 0.0]
    known += [f"termination/{name}" for name in (*task.terminations, "non_finite")]
    known += [f"metric/{name}" for name in task.metrics]
    if cfg.trainer.eval_episodes:
        known += [f"evaluation/{entry.name}" for entry in fields(Evaluation)]
    # Kinds whose names are all known here: another name of such a kind is a mistake.
    kinds = {name.partition("/")[0] for name in known} | {"evaluation", "metric", "reward"}
    for name in cfg.trainer.stop_at or {}:
        kind, slash, _ = name.partition("/")
        if name in known or (slash and kind in NAMED_LATER):
            continue
        # The algorithm's own: `loss/policy`, `update/kl`, `style/reward` and the like.
        if slash and kind not in kinds and (measured is None or name in measured):
            continue
        raise ValueError(
            f"trainer.stop_at: no metric is called {name!r}: {near(name, [*known, *(measured or [])])}"
        )
