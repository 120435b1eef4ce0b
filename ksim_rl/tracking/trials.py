"""Counts how often a policy follows a motion from its start to its end, over many trials in drawn worlds.

`ksim-rl eval RUN --trials 1024` runs them. The protocol is mjlab 1.x's, from its evaluation of tracking policies
(src/mjlab/tasks/tracking/scripts/evaluate.py): sensor noise, drawn worlds and errors at the start are on, pushes are
off unless they are asked for, and a trial succeeds if the motion ends before a limit on errors ends the trial: 0.25 m
in the height of the anchor and of feet and hands, 0.8 in how upright the anchor is (`ksim_rl.tracking.tasks`).
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.room import with_room
from ksim_rl.mdp.events import PushByVelocity
from ksim_rl.tracking.starts import StartInMotion
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.build import EVALUATION_SEED_OFFSET, build_env
from ksim_rl.trainers.evaluation import Evaluator
from ksim_rl.trainers.metrics import losses_of


@dataclass(frozen=True, kw_only=True)
class Trials:
    """The results of trials: the share of successes, and errors by metric, means over all steps of all trials."""

    trials: int
    success: float
    errors: dict[str, float]

    def __str__(self) -> str:
        errors = ", ".join(f"{name} {value:.3f}" for name, value in self.errors.items())
        return f"{self.success:.1%} of {self.trials} trials succeed; {errors}"


class TrialRunner(Evaluator):
    """Runs one trial in each env; `ended_well_E` and the sums of `errors_EM` are of these trials only."""

    def __init__(self, base: ManagerBasedRlEnv, **parts: Any) -> None:
        super().__init__(**parts)
        self._base = base
        device = self.length_E.device
        num_envs = self.length_E.shape[0]
        # float64 sums: thousands of steps lose digits in float32.
        self.ended_well_E = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.errors_EM = torch.zeros(
            num_envs, len(base.cfg.metrics), dtype=torch.float64, device=device
        )

    def _start(self) -> None:
        super()._start()
        self.ended_well_E.zero_()
        self.errors_EM.zero_()

    def _count_one_step(self) -> None:
        # Envs whose trial was running before this step.
        began_E = self._running_E.clone()
        super()._count_one_step()
        view = self._base.view
        metrics = self._base.cfg.metrics.values()
        # Time ran out, and nothing else ended the trial: the motion was followed to its end.
        ended_well_E = view.truncated_E & ~view.terminated_E
        self.ended_well_E.logical_or_(began_E & ~self._running_E & ended_well_E)
        # Where a trial has just ended, the next one's start is there to be seen.
        errors_EM = torch.stack([term(view) for term in metrics], dim=-1).to(torch.float64)
        self.errors_EM.add_(torch.where(self._running_E[:, None], errors_EM, 0.0))


def trial_cfg(cfg: ManagerBasedRlEnvCfg, *, pushes: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the config of trials of a tracking task: all begin with the motion, and nothing adapts.

    A ValueError if the task has no start in a motion.
    """
    events: dict[str, Any] = dict(cfg.events or {})
    starts = [name for name, event in events.items() if isinstance(event, StartInMotion)]
    if not starts:
        raise ValueError(
            f"events {sorted(events)}: none is a StartInMotion, so that there is no motion to follow: take a task such "
            "as g1_track_walk"
        )
    for name in starts:
        # From the first frame, and not from the parts of the curriculum.
        events[name] = dataclasses.replace(events[name], start_range=(0.0, 0.0), part_s=None)
    if not pushes:
        events = {
            name: event for name, event in events.items() if not isinstance(event, PushByVelocity)
        }
    return dataclasses.replace(cfg, events=events, curriculum={})


def run_trials(
    cfg: RunCfg,
    actor: TensorDictModuleBase,
    *,
    trials: int,
    seed: int | None = None,
    pushes: bool = False,
    note: Callable[[str], None],
) -> Trials:
    """Run trials of a policy of a tracking task, by its deterministic actions.

    `note` is told of room that worlds get, and of contacts and constraints that they lose.
    """
    if seed is None:
        seed = cfg.seed + EVALUATION_SEED_OFFSET
    of_trials = dataclasses.replace(cfg, task=trial_cfg(cfg.task, pushes=pushes))
    env = with_room(partial(build_env, of_trials, num_envs=trials, seed=seed), note=note)
    base = part(env, ManagerBasedRlEnv)
    assert base is not None
    files = {
        event.file for event in (base.cfg.events or {}).values() if isinstance(event, StartInMotion)
    }
    # The longest motion that any start may choose.
    duration_s = max(base.view.motion(file).duration_s for file in files)
    # Rounded up, but not for a rounding error of the division.
    runner = TrialRunner(
        base,
        env=env,
        policy=actor,
        max_steps=math.ceil(duration_s / base.step_dt - 1e-6),
        seed=seed,
    )
    runner()
    for text in losses_of(env):
        note(f"warning: {text}")
    # Per step of all trials, so that a long trial counts more than a short one.
    steps = runner.length_E.sum()
    errors = (runner.errors_EM.sum(0) / steps).tolist()
    success = float(runner.ended_well_E.double().mean())
    env.close(raise_if_closed=False)
    return Trials(
        trials=trials, success=success, errors=dict(zip(base.cfg.metrics, errors, strict=True))
    )
