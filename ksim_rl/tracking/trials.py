"""Counts how often a policy follows a motion from its start to its end, over many trials in drawn worlds.

`ksim-rl eval RUN --trials 1024` runs them. The protocol is mjlab 1.x's, from its evaluation of tracking policies
(src/mjlab/tasks/tracking/scripts/evaluate.py): sensor noise, drawn worlds and errors at the start are on, pushes are
off unless they are asked for, and a trial succeeds if the motion ends before a limit on errors ends the trial: 0.25 m
in the height of the anchor and of feet and hands, 0.8 in how upright the anchor is (`ksim_rl.tracking.tasks`).
"""

import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
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
from ksim_rl.mdp.motion_tracking import MotionFinished
from ksim_rl.mdp.terminations import TimeOut
from ksim_rl.scene.motions.motion_set import set_of
from ksim_rl.tracking.starts import StartInMotion, StartOfTrial
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.build import EVALUATION_SEED_OFFSET, build_env
from ksim_rl.trainers.evaluation import Evaluator
from ksim_rl.trainers.metrics import losses_of

MOST_ENVS = 8192
"""That trials of many clips run in at a time: more of them take more memory, and are no faster."""


@dataclass(frozen=True, kw_only=True)
class ClipTrials:
    """The results of the trials of one clip: the share of successes, and errors by metric, means over all steps."""

    clip: str
    held_out: bool
    success: float
    errors: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class Trials:
    """The results of trials of a motion.

    Attributes:
        trials: of each clip.
        success: the share of successes; of many clips the least of those that were trained on.
        errors: by metric, means over all steps of all trials; of many clips over those that were trained on.
        clips: the results by clip, where the motion has several.
        lost_worlds: in how many envs, at least, the physics had no room for all contacts and constraints.
    """

    trials: int
    success: float
    errors: dict[str, float]
    clips: tuple[ClipTrials, ...] = ()
    lost_worlds: int = 0

    @property
    def held_out(self) -> float | None:
        """The mean share of successes over the clips that were held out; None where there are none."""
        shares = [clip.success for clip in self.clips if clip.held_out]
        return statistics.fmean(shares) if shares else None

    def __str__(self) -> str:
        if not self.clips:
            return f"{self.success:.1%} of {self.trials} trials succeed; {_listed(self.errors)}"
        trained = [clip.success for clip in self.clips if not clip.held_out]
        lines = [
            f"{self.trials} trials of each of {len(self.clips)} clips; trained on {len(trained)}: "
            f"{statistics.fmean(trained):.1%} succeed, at least {self.success:.1%}; {_listed(self.errors)}"
        ]
        if self.held_out is not None:
            lines[0] += f"; held out {len(self.clips) - len(trained)}: {self.held_out:.1%} succeed"
        for clip in self.clips:
            mark = " (held out)" if clip.held_out else ""
            lines.append(f"  {clip.clip}{mark}: {clip.success:.1%}; {_listed(clip.errors)}")
        return "\n".join(lines)


def _listed(errors: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3f}" for name, value in errors.items())


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


def followed_motion(cfg: ManagerBasedRlEnvCfg) -> str:
    """Return the motion that trials of a tracking task follow; a ValueError if it starts in none, or in several."""
    events = cfg.events or {}
    motions = {
        name: event.file for name, event in events.items() if isinstance(event, StartInMotion)
    }
    if not motions:
        raise ValueError(
            f"events {sorted(events)}: none is a StartInMotion, so that there is no motion to follow: take a task such "
            "as g1_track_walk"
        )
    files = sorted(set(motions.values()))
    if len(files) > 1:
        raise ValueError(
            f"events {list(motions)} start in several motions ({', '.join(files)}), and trials follow one: start in "
            "one, or put the files into one set of motions, as task.scene.motions of g1_track has them"
        )
    return files[0]


def starting_by_choice(cfg: ManagerBasedRlEnvCfg, *, clip: str = "") -> ManagerBasedRlEnvCfg:
    """Return the config of a tracking task whose episodes begin with the clip that is chosen, `clip` at first.

    It has no curriculum. A ValueError if the task has no start in a motion, or starts in several.
    """
    followed_motion(cfg)
    events: dict[str, Any] = dict(cfg.events or {})
    for name, event in events.items():
        if isinstance(event, StartInMotion):
            fields = {field.name: getattr(event, field.name) for field in dataclasses.fields(event)}
            # From the first frame, and not from the parts of the curriculum.
            chosen = {"start_range": (0.0, 1.0), "part_s": None, "clip": clip}
            events[name] = StartOfTrial(**{**fields, **chosen})
    return dataclasses.replace(cfg, events=events, curriculum={})


def trial_cfg(cfg: ManagerBasedRlEnvCfg, *, pushes: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the config of trials of a tracking task: all begin with the motion, and nothing adapts.

    A ValueError if the task has no start in a motion, or starts in several.
    """
    cfg = starting_by_choice(cfg)
    events: dict[str, Any] = dict(cfg.events or {})
    if not pushes:
        events = {
            name: event for name, event in events.items() if not isinstance(event, PushByVelocity)
        }
    terminations = dict(cfg.terminations)
    # A time limit before the motion's end would be taken for a trial that followed it so far.
    if any(isinstance(term, MotionFinished) for term in terminations.values()):
        terminations = {
            name: term for name, term in terminations.items() if not isinstance(term, TimeOut)
        }
    return dataclasses.replace(cfg, events=events, terminations=terminations)


def run_trials(
    cfg: RunCfg,
    actor: TensorDictModuleBase,
    *,
    trials: int,
    seed: int | None = None,
    pushes: bool = False,
    note: Callable[[str], None],
) -> Trials:
    """Run trials of each clip of a tracking task by the deterministic actions of its policy.

    `note` reports room that worlds get, and contacts and constraints that they lose.
    """
    if seed is None:
        seed = cfg.seed + EVALUATION_SEED_OFFSET
    of_trials = dataclasses.replace(cfg, task=trial_cfg(cfg.task, pushes=pushes))
    file = followed_motion(cfg.task)
    clips = len(set_of(cfg.task.scene.motions, file).files())
    # As many clips at a time as fit into one env.
    at_once = min(clips, max(1, MOST_ENVS // trials))
    env = with_room(partial(build_env, of_trials, num_envs=trials * at_once, seed=seed), note=note)
    base = part(env, ManagerBasedRlEnv)
    assert base is not None
    start = StartOfTrial(file=file)
    motion = base.view.motion(file)
    runner = TrialRunner(base, env=env, policy=actor, max_steps=1, seed=seed)
    steps_C = []
    errors_CM = []
    success_C = []
    row_E = torch.arange(trials * at_once, device=base.device) // trials
    for first in range(0, clips, at_once):
        # Rows beyond the last clip try it once more, and are not counted.
        count = min(at_once, clips - first)
        start.chosen_clip(base.view).copy_((first + row_E).clamp(max=clips - 1))
        duration_s = float(motion.duration_C[first : first + count].max())
        # Rounded up, but not for a rounding error of the division.
        runner.max_steps = math.ceil(duration_s / base.step_dt - 1e-6)
        runner()
        rows = slice(0, count * trials)
        steps_C += runner.length_E[rows].view(count, trials).sum(1).tolist()
        errors_CM += runner.errors_EM[rows].view(count, trials, -1).sum(1).tolist()
        success_C += runner.ended_well_E[rows].double().view(count, trials).mean(1).tolist()
    losses = losses_of(env)
    for text in losses.lines:
        note(f"warning: {text}")
    env.close(raise_if_closed=False)
    names = list(base.cfg.metrics)
    trained = [place for place, held_out in enumerate(motion.held_out) if not held_out]
    return Trials(
        trials=trials,
        success=min(success_C[place] for place in trained),
        errors=_means(names, [steps_C[c] for c in trained], [errors_CM[c] for c in trained]),
        lost_worlds=losses.worlds,
        clips=tuple(
            ClipTrials(
                clip=name,
                held_out=motion.held_out[place],
                success=success_C[place],
                errors=_means(names, [steps_C[place]], [errors_CM[place]]),
            )
            for place, name in enumerate(motion.names if clips > 1 else ())
        ),
    )


def _means(
    names: Sequence[str], steps_C: Sequence[float], errors_CM: Sequence[Sequence[float]]
) -> dict[str, float]:
    """Return the errors of some clips per step of their trials, so that a long trial counts more than a short one."""
    steps = sum(steps_C)
    sums = [sum(column) for column in zip(*errors_CM, strict=True)]
    return {name: total / steps for name, total in zip(names, sums, strict=True)}
