"""Builds the objects of a run from its config."""

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl import envs, ranks
from ksim_rl.checked import named_files
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import ReplayCfg
from ksim_rl.device import state_tree
from ksim_rl.device.eager import eagerly
from ksim_rl.device.room import check_bytes, check_room
from ksim_rl.envs.contract import EpisodeClock, SimulatedWorld, part
from ksim_rl.modules import RecurrentStatePrimer, recurrent_transforms, state_spec
from ksim_rl.trainers.algorithm import FollowsEpisodes, HasWarmUp, make_update
from ksim_rl.trainers.checkpoint import Checkpoint, fitting
from ksim_rl.trainers.evaluation import Evaluator
from ksim_rl.trainers.loggers import check_installed, make_loggers
from ksim_rl.trainers.recorders import make_recorders, recorded_keys
from ksim_rl.trainers.run_cfg import RunCfg, with_engine
from ksim_rl.trainers.sources import check_targets
from ksim_rl.trainers.trainer import Hook, Trainer
from ksim_rl.transforms import stacked_frames

# Evaluations see other initial states than training does.
EVALUATION_SEED_OFFSET = 1_000_003
# The step limit of an evaluation where episodes have none.
UNLIMITED_EPISODE_STEPS = 1000
# Sixty threads take longer than eight for the little that torch does on the CPU of a GPU machine.
MOST_THREADS_BESIDE_CUDA = 8


def build(
    cfg: RunCfg,
    *,
    run_folder: Path | None = None,
    hooks: Sequence[Hook] = (),
    resume_from: Checkpoint | None = None,
) -> Trainer:
    """Build everything that a run needs, with all its memory allocated.

    With `collector.eager` nothing is recorded: the Python of rollouts, evaluations and updates runs each time.
    Torch's global seed, precision of products and number of CPU threads are set from the config. Without a `run_folder`
    nothing is written; without `resume_from` a new run starts, with the weights of `cfg.checkpoint` if it has one.
    Raises ValueError where a logger's package is missing, or a checkpoint is of another network or env.
    """
    # Before anything is built, which takes long.
    check_installed(cfg.logger)
    check_room(cfg, num_envs=cfg.num_envs, device=cfg.resolved_device())
    # Before any network is made, as the weights are drawn from it.
    torch.manual_seed(cfg.seed)
    torch.set_float32_matmul_precision(cfg.trainer.matmul_precision)
    # The same for convolutions, which have switches of their own; some of cuDNN's add up in no order.
    torch.backends.cudnn.allow_tf32 = cfg.trainer.matmul_precision != "highest"
    torch.backends.cudnn.deterministic = True
    torch.set_num_threads(cfg.trainer.num_threads or default_threads(cfg.resolved_device()))

    said: list[str] = []
    # "auto" may choose the C engine for few envs, which kernels cannot step.
    if cfg.collector.compile and cfg.task.sim.engine == "auto":
        cfg = with_engine(cfg, "warp")
        said.append(
            "collector.compile=true: MuJoCo Warp simulates, as no kernel steps MuJoCo's C engine"
        )
    env = envs.with_room(
        partial(build_env, cfg, num_envs=cfg.num_envs, seed=cfg.seed), note=said.append
    )
    # The engine that was chosen for these envs is also the one of evaluations, which are fewer, and of resumed runs.
    simulated = part(env, SimulatedWorld)
    if simulated is not None:
        cfg = with_engine(cfg, simulated.world.engine)
    with eagerly(cfg.collector.eager):
        resumed = state_tree.branch(resume_from.state, "update") if resume_from else None
        update = make_update(cfg, env, resumed=resumed)
    if cfg.trainer.stop_at and not hooks:  # which may log figures of their own
        check_targets(cfg, update.metrics())
    # It stores only the leaves that the update reads, or a recorder.
    keys = list(dict.fromkeys([*update.rollout_keys, *recorded_keys(cfg, env)]))
    _check_rollout(cfg, env, keys)
    collector = RolloutCollector(
        env,
        update.behavior,
        rollout_length=cfg.data.rollout_length(cfg.num_envs),
        keys=keys,
        cfg=cfg.collector,
    )
    if isinstance(update, FollowsEpisodes):
        collector.listeners.append(_Restarts(update))
    trainer = Trainer(
        cfg.trainer,
        collector=collector,
        update=update,
        evaluator=build_evaluator(cfg, update.actor) if cfg.trainer.eval_episodes else None,
        solved_at=solved_at(cfg),
        hooks=hooks,
        folder=run_folder / "checkpoint" if run_folder else None,
        config=cfg.to_tree(),
    )
    trainer.notes = said
    # Before anything is loaded: a replay need not be kept apart meanwhile.
    began = time.monotonic()
    collector.warm_up()
    if cfg.trainer.warm_up and isinstance(update, HasWarmUp):
        update.warm_up(collector.made_up_rollout())
    if cfg.trainer.warm_up or collector.compiled_step is not None:
        trainer.warm_up_s = time.monotonic() - began
    # A resumed run loads everything; a run from a checkpoint only the networks.
    if resume_from is not None:
        with fitting(resume_from.path):
            trainer.load_state_dict(resume_from.state)
    elif cfg.checkpoint is not None:
        with fitting(Path(cfg.checkpoint)):
            trainer.load_weights(Path(cfg.checkpoint))
    if run_folder is not None and ranks.rank() == 0:
        # Last, because a run that cannot be built must not show up anywhere.
        trainer.loggers = make_loggers(cfg.logger, run_folder, config=trainer.config)
        recorders = make_recorders(cfg, env, run_folder, iteration=trainer.iteration)
        collector.listeners.extend(recorders)
    return trainer


class _Restarts:
    """Tells an update where all envs were reset between two rollouts: a listener of the collector."""

    def __init__(self, update: FollowsEpisodes) -> None:
        self._update = update

    def record(self, rollout_ET: TensorDictBase, *, restarted: bool = False) -> None:
        """Pass it on, before the update learns from the rollout."""
        if restarted:
            self._update.restarted()

    def close(self) -> None:
        """Do nothing: there is nothing to write."""


def _check_rollout(cfg: RunCfg, env: EnvBase, keys: Sequence[NestedKey]) -> None:
    """Refuse rollouts, and a replay, whose observations alone no memory holds, before the first of their steps."""
    now = following = kept = 0
    stacks = stacked_frames(env)
    for key, leaf in env.observation_spec.items(include_nested=True, leaves_only=True):
        # Of one env state.
        size = leaf.shape.numel() * leaf.dtype.itemsize // cfg.num_envs
        if key in keys:
            now += size
            kept += size // len(stacks.get(key, (0,)))
        if unravel_key(("next", key)) in keys:
            following += size
    length = cfg.data.rollout_length(cfg.num_envs)
    needed = length * cfg.num_envs * (now + following)
    # A replay keeps each observation once, and of stacked ones each frame; an update that copies none has the rollout.
    if isinstance(cfg.data, ReplayCfg):
        needed += cfg.data.capacity * cfg.num_envs * kept
    check_bytes(
        f"rollouts of {length} steps, by {cfg.data}, with {now + following:,} bytes of observations in each env state",
        needed,
        num_envs=cfg.num_envs,
        device=cfg.resolved_device(),
    )


def default_threads(device: torch.device) -> int:
    """Return torch's CPU threads: with CUDA all cores but one; without it one, as sums depend on their number."""
    if device.type == "cuda":
        return max(1, min((os.cpu_count() or 1) - 1, MOST_THREADS_BESIDE_CUDA))
    return 1


def build_env(cfg: RunCfg, *, num_envs: int, seed: int, render_mode: str | None = None) -> EnvBase:
    """Build the env of a run, with another number of envs and another seed.

    It carries the memory of a recurrent policy, and tells recurrent networks where episodes begin.
    """
    # Sets that the objective alone reads, and no term of the task: an env would refuse them.
    others = named_files(cfg.objective) - named_files(cfg.task)
    motions = {
        name: chosen for name, chosen in cfg.task.scene.motions.items() if name not in others
    }
    scene = dataclasses.replace(cfg.task.scene, num_envs=num_envs, motions=motions)
    task = dataclasses.replace(cfg.task, scene=scene, seed=seed)
    env = envs.build(task, device=cfg.resolved_device(), render_mode=render_mode)
    if cfg.modules.recurrent:
        # Only an actor acts in the env, so only its memory has to travel with the env states.
        actor = cfg.modules.recurrent_actor
        if actor is None:
            primers = []
        else:
            primers = [RecurrentStatePrimer(state_spec(actor, "actor"))]
        for transform in recurrent_transforms(env, *primers):
            env.append_transform(transform)
    return env


def build_evaluator(
    cfg: RunCfg,
    actor: TensorDictModuleBase,
    *,
    episodes: int | None = None,
    seed: int | None = None,
    note: Callable[[str], None] | None = None,
) -> Evaluator:
    """Build an evaluator with its own envs, without sensor noise and curricula.

    Weights and ranges are the config's, whatever levels curricula have reached in training. With a `note`, the
    worlds get room by a rehearsal, as in training, and `note` reports it; in the process of a run they have it already.
    """
    if seed is None:
        seed = cfg.seed + EVALUATION_SEED_OFFSET
    # Curricula adapt to training episodes, and must not move in an evaluation.
    cfg = dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, curriculum={}))
    all_ranks = episodes or cfg.trainer.eval_episodes
    # The episodes are shared by the ranks, rounded up.
    make = partial(build_env, cfg, num_envs=-(-all_ranks // ranks.size()), seed=seed)
    if note is None:
        env = make()
    else:
        env = envs.with_room(make, note=note)
    # Transforms with noise leave it out in this mode.
    env.eval()
    clock = part(env, EpisodeClock)
    max_steps = (clock and clock.max_episode_length) or UNLIMITED_EPISODE_STEPS
    with eagerly(cfg.collector.eager):
        return Evaluator(env, actor, max_steps=max_steps, seed=seed)


def solved_at(cfg: RunCfg) -> float | None:
    """Return the evaluation return that counts as solved, or None where the task has no such figure."""
    if cfg.task_name in envs.names():
        return envs.task(cfg.task_name).solved_at
    return None
