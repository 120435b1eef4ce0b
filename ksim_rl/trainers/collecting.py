"""Collects whole episodes of a policy into a folder."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl import envs, ranks
from ksim_rl.checked import Checked, Count, Seed
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import EpisodeRecorder, EpisodeWriter, leaves_of
from ksim_rl.data.episode_folder import Contents
from ksim_rl.data.recorder_cfg import shared
from ksim_rl.device.eager import eagerly
from ksim_rl.files.writing import write_whole
from ksim_rl.runs.listing import CONFIG
from ksim_rl.runs.record import recorded
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.interrupt import InterruptRequest
from ksim_rl.trainers.recorders import env_state_keys, max_length_of, origin_of
from ksim_rl.trainers.run_cfg import RunCfg

# So many steps are on their way to the disk at once.
ROLLOUT_LENGTH = 32


@dataclass(frozen=True, kw_only=True)
class CollectCfg(Checked):
    """How episodes are collected.

    Attributes:
        num_episodes: of all envs; each gives as many, give or take one.
        num_envs: at the same time.
        as_in_training: actions are drawn as the policy draws them, and observations have the noise of training; else
            actions are deterministic, without noise, as in evaluations.
    """

    num_episodes: Count
    num_envs: Count
    seed: Seed = 0
    as_in_training: bool = False

    @property
    def episodes_E(self) -> list[int]:
        """How many episodes each env gives."""
        return shared(self.num_episodes, self.num_envs)


def collect_episodes(
    cfg: RunCfg,
    make_policy: Callable[[EnvBase], TensorDictModuleBase],
    folder: Path,
    how: CollectCfg,
    *,
    title: str,
    note: Callable[[str], None],
) -> tuple[Contents, InterruptRequest]:
    """Let a policy act in the env of a run's config, without curricula, and write whole episodes to a new folder.

    Beside the episodes it has the config, and `run.json` with command, code and versions. Returns what the folder
    holds, and the signal that cut it short, if one did: then these are fewer episodes than were asked for. A ValueError
    refuses a folder that holds something, envs whose episodes have no end, and several ranks.
    """
    if ranks.size() > 1:
        raise ValueError("episodes are collected by one process: start it without torchrun")
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder}: it holds something: name a new folder")
    # Levels of curricula are of a training.
    cfg = replace(cfg, task=replace(cfg.task, curriculum={}))
    env = envs.with_room(partial(build_env, cfg, num_envs=how.num_envs, seed=how.seed), note=note)
    if not how.as_in_training:
        env.eval()
    max_length = max_length_of(env)
    policy = make_policy(env)
    with eagerly(cfg.collector.eager):
        collector = RolloutCollector(
            env,
            policy,
            rollout_length=min(ROLLOUT_LENGTH, max_length),
            keys=env_state_keys(env),
            cfg=replace(cfg.collector, stagger_episodes=False, rollout_length=None),
            explores=how.as_in_training,
        )
    # The first rollout compiles what it needs, before anything is written.
    rollout_ET = collector.collect()
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create(cfg.to_tree())))
    origin = origin_of(cfg, env, title=title, policy=policy)
    said = "the recording ends after this rollout; once more ends it at once"
    with recorded(folder, note=note) as ended, InterruptRequest(said) as interrupt:
        writer = EpisodeWriter(folder, leaves_of(rollout_ET), origin=origin, asked=how.num_episodes)
        with EpisodeRecorder(writer, episodes_E=how.episodes_E, max_length=max_length) as recorder:
            recorder.record(rollout_ET)
            while not recorder.is_done and not interrupt:
                recorder.record(collector.collect())
        if recorder.is_done:
            ended("done", "")
        else:
            ended("interrupted", f"by {interrupt.signal}")
    env.close(raise_if_closed=False)
    return writer.contents, interrupt
