"""Runs a training in a run folder: config, training, evaluation, learning curves, video."""

import dataclasses
import json
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase

from ksim_rl import ranks
from ksim_rl.config.class_paths import loading_notes
from ksim_rl.config.plugins import load as load_plugins
from ksim_rl.device import state_tree
from ksim_rl.device.memory import memory_for
from ksim_rl.device.room import check_room
from ksim_rl.envs.contract import EpisodeClock, part
from ksim_rl.files.writing import whole_file, write_whole
from ksim_rl.runs.listing import CONFIG, METRICS
from ksim_rl.runs.record import recorded
from ksim_rl.runs.run_lock import locked
from ksim_rl.runs.watch import threads_that_fail, watch
from ksim_rl.trainers import checkpoint, kept_models, recorders, video
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.build import build, build_env
from ksim_rl.trainers.other_physics import trained_with
from ksim_rl.trainers.outcome import Outcome
from ksim_rl.trainers.progress import RunProgress
from ksim_rl.trainers.run_cfg import RunCfg, with_engine
from ksim_rl.trainers.trainer import Hook, Trainer
from ksim_rl.trainers.trial import first_that_fits
from ksim_rl.transforms import observation_columns

# Folders in a run folder that a run writes to.
FOLDERS = (
    "checkpoint",
    kept_models.FOLDER,
    recorders.FOLDER,
    "tensorboard",
    "wandb",
    "mlflow",
)
EVALUATION = "evaluation.json"
CURVES = "curves.png"
VIDEO = "video.mp4"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Policy:
    """A trained policy with the config of its run."""

    cfg: RunCfg
    actor: TensorDictModuleBase
    iteration: int


def run(
    cfg: RunCfg,
    run_folder: Path,
    *,
    progress: RunProgress,
    hooks: Sequence[Hook] = (),
    resume_from: checkpoint.Checkpoint | None = None,
    before: Callable[[Trainer], None] | None = None,
) -> Outcome:
    """Train, and leave in `run_folder` record, config, models, metrics, checkpoints, evaluation, curves and a video.

    A picture that cannot be drawn (no OpenGL) is noted in one line of `progress`. `before` is called when all parts are
    built. Raises ValueError when another process writes the folder, the checkpoint to resume or start from belongs to
    another config, or memory does not suffice; OSError when the folder is deleted or moved meanwhile, or the last
    checkpoint cannot be saved.
    """
    # Ranks with other settings would wait for each other in collectives of other sizes.
    ranks.check_same({**cfg.to_tree(), "device": cfg.resolved_device().type}, what="config")
    # The graphs that the first iterations record take memory as well. Several ranks cannot try on their own.
    if ranks.size() > 1:
        few = None
    else:
        few = partial(first_that_fits, cfg, note=progress.note)
    explained = memory_for(cfg.num_envs, cfg.resolved_device(), few)
    make = partial(build, cfg, run_folder=run_folder, hooks=hooks, resume_from=resume_from)
    if ranks.rank():  # rank 0 writes for all
        with explained:
            trainer = make()
        outcome = trainer.train(progress)
        _close(trainer)
        return outcome
    # From here on rank 0 only: folder, lock, record and pictures.
    run_folder.mkdir(parents=True, exist_ok=True)
    try:
        with locked(run_folder, note=progress.note), threads_that_fail(progress.note), explained:
            return _run_locked(cfg, run_folder, progress, make, before)
    except BaseException:
        with suppress(OSError):
            run_folder.rmdir()  # only where nothing is in it yet
        raise


def _run_locked(
    cfg: RunCfg,
    run_folder: Path,
    progress: RunProgress,
    make: Callable[[], Trainer],
    before: Callable[[Trainer], None] | None,
) -> Outcome:
    # Tell now which classes a later command may not find, and not when the run is resumed.
    for note in loading_notes(cfg.to_tree()):
        progress.note(note)
    # Under the lock no other process writes here, so unfinished files are leftovers of a crash.
    for folder in (run_folder, run_folder / "checkpoint"):
        checkpoint.remove_leftovers(folder)
    with progress.busy("building envs and networks"):
        trainer = make()
    # The engine that "auto" has chosen, so that config.yaml names it.
    cfg = with_engine(cfg, trained_with(trainer.config))
    if before is not None:
        before(trainer)
    # Models and config are written before training, so that an interrupted run can be resumed.
    kept_models.keep_models(cfg, run_folder, note=progress.note)
    write_whole(run_folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create(cfg.to_tree())))
    # Ends the run when its folder is deleted or moved.
    trainer.watch = watch(run_folder, holds=CONFIG, note=progress.note)
    with recorded(run_folder, note=progress.note) as ended:
        outcome = trainer.train(progress)
        ended("done" if outcome.interrupted_by is None else "interrupted", outcome.why)
    trainer.watch()
    # The figures of the last evaluation, for tools and people.
    if outcome.evaluation is not None:
        figures = {
            "iteration": outcome.iteration,
            **dataclasses.asdict(outcome.evaluation),
            "solved_at": trainer.solved_at,
        }
        if trainer.solved_at is not None:
            figures["solved"] = outcome.solved
        write_whole(run_folder / EVALUATION, json.dumps(figures, indent=2) + "\n")
    # Pictures come last: they may fail without harm to the run.
    with progress.busy("drawing learning curves and video"):
        _draw_curves(cfg, run_folder, solved_at=trainer.solved_at, note=progress.note)
        # A run that was asked to stop does not begin to draw.
        if cfg.trainer.video and outcome.interrupted_by is None:
            path = run_folder / VIDEO
            record_video(
                cfg, trainer.update.actor, path, note=progress.note, status=progress.status
            )
    _close(trainer)
    return outcome


def _close(trainer: Trainer) -> None:
    for owner in (trainer.collector, trainer.evaluator):
        if owner is not None:
            owner.env.close(raise_if_closed=False)


def load_policy(path: Path, *, device: str = "auto", plugins: Sequence[str] = ()) -> Policy:
    """Rebuild the policy of a checkpoint, or of the newest one in a run folder.

    `plugins` are packages to import first, whose classes the run's config may then name. Nothing is written: the run's
    `nan_guard` is off. Raises CheckpointError when there is none, or it is damaged; ValueError when its config does not
    fit this version, or makes other observations.
    """
    load_plugins(plugins)
    return policy_of(checkpoint.load_latest(path), device=device)


def policy_of(
    saved: checkpoint.Checkpoint, *, device: str = "auto", cfg: RunCfg | None = None
) -> Policy:
    """Rebuild the policy of a checkpoint that was read; see `load_policy`. A `cfg` stands in for the run's own.

    Its models are those that the run began with, see `kept_models`.
    """
    if cfg is None:
        cfg = RunCfg.from_tree({**saved.config, "device": device})
    cfg = without_nan_guard(kept_models.with_kept_models(cfg, saved.run_folder))
    check_room(cfg.modules, num_envs=1, device=cfg.resolved_device(), path="modules")
    # One env is enough: the networks' shapes follow from its specs.
    env = build_env(cfg, num_envs=1, seed=cfg.seed)
    actor = make_policy(cfg, env)
    with checkpoint.fitting(saved.path):
        # Columns first: equal sizes with other terms would load in silence.
        columns = checkpoint.columns_of(saved.state)
        checkpoint.check_columns(columns, observation_columns(env))
        update = state_tree.branch(saved.state, "update")
        state_tree.copy_into(actor.state_dict(), state_tree.branch(update, "actor"), what="actor")
    env.close(raise_if_closed=False)
    return Policy(cfg=cfg, actor=actor, iteration=saved.iteration)


def without_nan_guard(cfg: RunCfg) -> RunCfg:
    """Return the config of a run that only looks on, and leaves no files of states that are not finite."""
    task = dataclasses.replace(cfg.task, sim=dataclasses.replace(cfg.task.sim, nan_guard=None))
    return dataclasses.replace(cfg, task=task)


def record_video(
    cfg: RunCfg,
    actor: TensorDictModuleBase,
    path: Path,
    *,
    note: Callable[[str], None],
    status: Callable[[str], None] = lambda _: None,
    seconds: float | None = None,
    fps: float = video.FPS,
    seed: int = 0,
) -> Path | None:
    """Record the policy in one env; where that is impossible, say why and how to mend it, and return None."""
    # Without noise, and with a camera.
    env = build_env(cfg, num_envs=1, seed=seed, render_mode="rgb_array")
    env.eval()
    clock = part(env, EpisodeClock)
    assert clock is not None  # the env of a config is ours
    steps = max(1, round((seconds or cfg.trainer.video_s) / clock.step_dt))
    try:
        with warnings.catch_warnings():
            # Each OpenGL platform that fails warns on its own; the error says it once, with the fix.
            warnings.filterwarnings("ignore", module="glfw")
            how = {"steps": steps, "step_dt": clock.step_dt, "fps": fps, "seed": seed}
            return video.record(env, actor, path, status=status, **how)
    except video.VideoUnavailableError as error:
        note(f"no video: {error}")
        return None
    finally:
        env.close(raise_if_closed=False)


def _draw_curves(
    cfg: RunCfg, run_folder: Path, *, solved_at: float | None, note: Callable[[str], None]
) -> None:
    table = run_folder / METRICS
    # Say why, since an absent picture looks like a fault.
    if not table.exists():
        if cfg.logger.csv:
            reason = "which has no rows yet"
        else:
            reason = "which needs logger.csv=true"
        note(f"no learning curves: they are drawn from metrics.csv, {reason}")
        return
    from ksim_rl.runs import curves  # Matplotlib takes half a second to import

    title = f"{cfg.task_name}: {cfg.num_envs} envs on {cfg.device}, seed {cfg.seed}"
    try:
        with whole_file(run_folder / CURVES) as temporary:
            curves.draw(table, temporary, title=title, solved_at=solved_at)
    except (ValueError, OSError) as error:
        note(f"no learning curves: {error}")
