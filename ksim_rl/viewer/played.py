"""Finds the policy that a command plays in a task: of a run or of the zoo, or an agent without one."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl import conf
from ksim_rl.trainers import RunCfg, checkpoint
from ksim_rl.trainers.other_physics import ENGINE, judged_by, trained_with
from ksim_rl.trainers.run_cfg import check_run_tree
from ksim_rl.trainers.run_folder import policy_of, without_nan_guard
from ksim_rl.viewer.driven_agent import HAND, DrivenAgent
from ksim_rl.viewer.session import UntrainedAgent, showing_motion
from ksim_rl.viewer.shown_motion import following, place_of
from ksim_rl.zoo import locate


@dataclass(frozen=True, kw_only=True)
class Played:
    """A policy or agent to play: a run's policy, or an agent in a task (`actor` is None, and `agent` its kind)."""

    cfg: RunCfg
    title: str
    folder: Path
    actor: TensorDictModuleBase | None = None
    agent: str = ""

    def policy(self, env: EnvBase) -> TensorDictModuleBase:
        """Return the policy that acts in an env of `cfg`."""
        if self.agent == HAND:
            return DrivenAgent(env)
        if self.actor is None:
            return UntrainedAgent(self.agent, env)
        return self.actor


def names_run(first: str) -> bool:
    """Return whether the first word of a command is a run or one of the zoo, and no field of a config."""
    # A path may hold "=", so one that exists is a run.
    return "=" not in first or Path(first).exists()


def find(
    what: Sequence[str], *, agent: str | None, device: str, motion: str | None = None
) -> Played:
    """Find a run, a policy of the zoo, or with an agent a task, with changes to its config.

    `what` is a run folder, one of its checkpoints, `zoo:NAME` or `task=NAME`, and then `field=value`. A run's own
    policy acts where `agent` is None. With a `motion`, its name or file, the scene of a task plays it, and the policy
    of a run follows it from its start, if it is a clip of its task's motion.
    """
    first, *overrides = what
    is_run = names_run(first)
    if motion is not None and agent is not None:
        raise ValueError(f"--motion {motion} with --agent {agent}: nothing acts in a motion")
    if motion is not None and not is_run:
        return _motion(what, motion, device=device)
    if not is_run:
        if agent is None or not any(text.startswith("task=") for text in what):
            raise ValueError(
                f"{first!r}: expected a run folder, or task=NAME with --agent zero or random, or hand, as it has no "
                "policy"
            )
        return _without_policy(conf.compose([*what, f"device={device}"], learns=False), agent)
    changed = None
    physics = ""
    # `locate` also takes names of the zoo.
    saved = checkpoint.load_latest(locate(first))
    if overrides:
        fields = conf.fields_of(overrides)
        # A run's folder may be a stranger's: its config must not reach outside.
        check_run_tree(saved.config, saved.path, given=fields)
        changed = conf.changed({**saved.config, "device": device}, saved.path, overrides)
        changed = dataclasses.replace(changed, device=device)
        # Another engine brings another integrator and time step, which the title tells.
        if ENGINE in fields:
            changed, words = judged_by(changed, trained=trained_with(saved.config), given=fields)
            physics = f", {words}"
    policy = policy_of(saved, device=device, cfg=changed)
    # An agent in a run's task: the policy is dropped, its config stays.
    if agent is not None:
        return _without_policy(policy.cfg, agent)
    title = f"{policy.cfg.task_name}, iteration {policy.iteration}{physics}"
    cfg = policy.cfg
    if motion is not None:
        cfg = dataclasses.replace(cfg, task=following(cfg.task, motion))
        title += f", motion {motion}"
    return Played(cfg=cfg, title=title, folder=saved.run_folder, actor=policy.actor)


def _motion(what: Sequence[str], motion: str, *, device: str) -> Played:
    """Return a motion to play in the scene of a task."""
    if not any(text.startswith("task=") for text in what):
        raise ValueError(f"--motion {motion}: name a task with the motion's robot: task=NAME")
    cfg = conf.compose([*what, f"device={device}"], learns=False)
    file, clip = place_of(cfg.task, motion)
    shown = dataclasses.replace(cfg, task=showing_motion(cfg.task, file, clip=clip))
    played = _without_policy(shown, "zero")
    return dataclasses.replace(played, title=f"{cfg.task_name}, motion {motion}")


def _without_policy(cfg: RunCfg, agent: str) -> Played:
    return Played(
        cfg=without_nan_guard(cfg),
        title=f"{cfg.task_name}, driven by hand"
        if agent == HAND
        else f"{cfg.task_name}, {agent} actions",
        folder=Path(),
        agent=agent,
    )
