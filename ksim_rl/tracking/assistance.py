"""Helps a robot to follow a motion that it cannot do by itself, and takes the help away again.

A motion that asks for more than the ground can give (a person's, retargeted) has no policy that follows it. With help
at its root a robot stays near it while it learns what its legs can do; the less help there is, the more the policy has
to leave the motion for one that is feasible. What it does in the end without help is written as the reference that
another policy learns (`rolled_out`).
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.checks import check_count
from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.room import with_room
from ksim_rl.envs.term import EventMode, EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.curricula import LinearLevel
from ksim_rl.mdp.motion_tracking import OfMotion
from ksim_rl.scene import quaternion
from ksim_rl.scene.state.motion_clock import motion_bodies
from ksim_rl.tracking.reference import motion_velocities
from ksim_rl.tracking.starts import StartOfTrial
from ksim_rl.tracking.trials import TrialRunner, followed_motion, trial_cfg
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.build import EVALUATION_SEED_OFFSET, build_env

ASSISTANCE = "assistance"
WITHDRAWAL = "withdrawal"
"""The event, and the curriculum that takes it away."""


@dataclass(frozen=True, kw_only=True)
class AssistRoot(OfMotion, EventTerm):
    """Pull the first robot's free root towards where the motion has it, by a bounded wrench at its centre of mass.

    The force is `stiffness` times the root's way to the motion's (m) and `damping` times the difference of their
    velocities, the torque likewise, with twice the sine of half the angle between them; both are bounded, and then
    multiplied by 1 - `view.level`, so that a level of 1 means no help at all. Without a curriculum the level is 1.

    Attributes:
        stiffness, damping: N/m and N s/m.
        turn_stiffness, turn_damping: N m/rad and N m s/rad.
        max_force, max_torque: N and N m.
    """

    mode: EventMode = "step"
    stiffness: Positive
    damping: NonNegative
    turn_stiffness: Positive
    turn_damping: NonNegative
    max_force: Positive
    max_torque: Positive

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.mode != "step":
            raise ValueError(
                f"mode={self.mode!r}: expected 'step', since the help follows the motion"
            )

    def wrench(self, view: EnvView) -> Float[Tensor, "E 6"]:
        """Return force (N) and torque (N m) of the whole help, world frame."""
        root = view.robot
        pos_EN3, quat_EN4 = motion_bodies(view, self.file, root.root.name)
        lin_vel_EN3, ang_vel_EN3 = motion_velocities(view, self.file, root.root.name)
        turn_E4 = quaternion.multiply(quat_EN4[:, 0], quaternion.conjugate(root.root_quat_EL))
        # Of the two quaternions of a turn the one that goes the shorter way.
        shorter_E1 = torch.where(turn_E4[:, :1] < 0.0, -1.0, 1.0)
        force_E3 = self.stiffness * (pos_EN3[:, 0] - root.root_pos_EL)
        force_E3 = force_E3 + self.damping * (lin_vel_EN3[:, 0] - root.root_lin_vel_w_EL)
        torque_E3 = self.turn_stiffness * 2.0 * shorter_E1 * turn_E4[:, 1:]
        torque_E3 = torque_E3 + self.turn_damping * (ang_vel_EN3[:, 0] - root.root_ang_vel_w_EL)
        return torch.cat(
            (_bounded(force_E3, self.max_force), _bounded(torque_E3, self.max_torque)), dim=-1
        )

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        applied_E6 = view.buffer("applied_E6", 6)
        share = 1.0 - view.level
        # A wrench that is not finite must not outlive its help: zero times it would be NaN.
        wrench_E6 = torch.where(share > 0.0, share * self.wrench(view), 0.0)
        wrench_E6 = torch.where(mask_E[:, None], wrench_E6, applied_E6)
        body = view.robot.root.id
        # Only the change is added: pushes may press on the same body.
        view.world.xfrc_applied_EL[:, body].add_(wrench_E6 - applied_E6)
        applied_E6.copy_(wrench_E6)


def _bounded(vector_E3: Tensor, most: float) -> Tensor:
    length_E1 = torch.linalg.vector_norm(vector_E3, dim=-1, keepdim=True)
    return vector_E3 * (most / length_E1.clamp_min(most))


def assisted(
    cfg: ManagerBasedRlEnvCfg, assist: AssistRoot, *, begin_step: int, end_step: int
) -> ManagerBasedRlEnvCfg:
    """Return the config of a tracking task with help, which is withdrawn between two counts of env steps."""
    withdrawal = LinearLevel(begin_step=begin_step, end_step=end_step)
    return dataclasses.replace(
        cfg,
        events={**(cfg.events or {}), ASSISTANCE: assist},
        curriculum={**cfg.curriculum, WITHDRAWAL: withdrawal},
    )


def without_help(cfg: ManagerBasedRlEnvCfg, *, clip: str = "") -> ManagerBasedRlEnvCfg:
    """Return the config of trials without help, in one clip of several."""
    events: dict[str, EventTerm] = {}
    for name, event in (cfg.events or {}).items():
        if isinstance(event, AssistRoot):
            continue
        if isinstance(event, StartOfTrial):
            event = dataclasses.replace(event, clip=clip)
        events[name] = event
    return dataclasses.replace(cfg, events=events)


class RolloutRunner(TrialRunner):
    """Runs trials, and keeps the states of the robots in `qpos_TEL`: at the start, and after each env step."""

    def __init__(self, base: ManagerBasedRlEnv, **parts: Any) -> None:
        super().__init__(base, **parts)
        now_EL = base.world.qpos_EL
        self.qpos_TEL = now_EL.new_zeros((self.max_steps + 1, *now_EL.shape))
        # On the device: a step is replayed as a graph, in which no Python counts.
        self._frame_1 = torch.zeros(1, dtype=torch.int64, device=now_EL.device)

    def _start(self) -> None:
        super()._start()
        self._frame_1.zero_()
        self._keep_state()

    def _count_one_step(self) -> None:
        super()._count_one_step()
        self._keep_state()

    def _keep_state(self) -> None:
        self.qpos_TEL.index_copy_(0, self._frame_1, self._base.world.qpos_EL[None])
        self._frame_1.add_(1)


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """What a policy did along a motion, without help.

    Attributes:
        qpos_FL: of the trial that was nearest to the motion, at `fps` frames per second.
        success: the share of trials that came to the end of the motion.
        error: of this trial, by the first metric of the task, the mean over its steps.
    """

    qpos_FL: Float[np.ndarray, "F L"]
    fps: float
    success: float
    error: float


def rolled_out(
    cfg: RunCfg,
    actor: TensorDictModuleBase,
    *,
    clip: str = "",
    trials: int = 64,
    seed: int | None = None,
    note: Callable[[str], None],
) -> tuple[Rollout, mujoco.MjModel]:
    """Let a policy follow a motion to its end without help, and return the best trial and the robot's MjModel.

    Actions are deterministic, without noise on observations, pushes and help. `clip` is one of several. A ValueError
    refuses a policy that does not come to the end: what it does is no reference.
    """
    check_count("trials", trials)
    if seed is None:
        seed = cfg.seed + EVALUATION_SEED_OFFSET
    file = followed_motion(cfg.task)
    alone = dataclasses.replace(cfg, task=without_help(trial_cfg(cfg.task), clip=clip))
    env = with_room(partial(build_env, alone, num_envs=trials, seed=seed), note=note)
    env.eval()
    base = part(env, ManagerBasedRlEnv)
    assert base is not None
    try:
        return _best(base, env, actor, file, clip=clip, seed=seed), base.world.mj_model
    finally:
        env.close(raise_if_closed=False)


def _best(
    base: ManagerBasedRlEnv,
    env: EnvBase,
    actor: TensorDictModuleBase,
    file: str,
    *,
    clip: str,
    seed: int,
) -> Rollout:
    motion = base.view.motion(file)
    place = motion.names.index(clip) if clip else 0
    steps = math.ceil(float(motion.duration_C[place]) / base.step_dt - 1e-6)
    runner = RolloutRunner(base, env=env, policy=actor, max_steps=steps, seed=seed)
    runner()
    success = float(runner.ended_well_E.double().mean())
    if not success:
        raise ValueError(
            f"motion {file}: in none of {len(runner.ended_well_E)} trials the policy comes to its end without help, "
            f"and the farthest lasts {int(runner.length_E.max()) * base.step_dt:.2f} s: train it longer, or withdraw "
            "the help more slowly"
        )
    error_E = runner.errors_EM[:, 0] / runner.length_E.clamp_min(1)
    best = int(torch.where(runner.ended_well_E, error_E, torch.inf).argmin())
    # The last step's state already belongs to the next start.
    qpos_FL = runner.qpos_TEL[: int(runner.length_E[best]), best].double().cpu().numpy()
    return Rollout(
        qpos_FL=qpos_FL, fps=1.0 / base.step_dt, success=success, error=float(error_E[best])
    )
