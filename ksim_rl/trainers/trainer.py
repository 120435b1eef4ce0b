"""The training loop collects and learns in turn, and reports, evaluates and saves beside that."""

import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.collectors import RolloutCollector
from ksim_rl.envs.contract import EpisodeClock, missing_parts, part
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.algorithm import Update
from ksim_rl.trainers.evaluation import Evaluation, Evaluator
from ksim_rl.trainers.hooks import CheckpointHook, EvaluationHook, Hook
from ksim_rl.trainers.interrupt import InterruptRequest
from ksim_rl.trainers.loggers import MetricLogger
from ksim_rl.trainers.metrics import (
    PendingMetrics,
    episode_means,
    explain_physics,
    read_episode_sums,
    read_physics,
    start_copy,
    without_counts,
)
from ksim_rl.trainers.progress import RunClock, RunProgress
from ksim_rl.trainers.run_cfg import TrainerCfg
from ksim_rl.transforms import observation_columns


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a run ended.

    `solved` is None where the task has no threshold or nothing was evaluated, `target_met` where no target was set.
    """

    iteration: int
    env_states: int
    seconds: float
    evaluation: Evaluation | None
    solved: bool | None
    target_met: bool | None
    interrupted_by: signal.Signals | None


class Trainer:
    """Collects, learns, and beside that logs, evaluates and saves.

    The metrics of an iteration come to the host in one copy. On CUDA they are read while the next iteration runs, so
    that the device never waits for logs; before a hook is called the run is settled first.

    Args:
        cfg: how long, and how often what.
        collector: gives the rollouts; its env is the one that is trained in.
        update: improves the networks with a rollout.
        evaluator: judges the policy; None never evaluates.
        solved_at: the mean evaluation return that counts as solved.
        loggers: take the metrics.
        hooks: what else to do between iterations; they run after an evaluation and before a checkpoint.
        folder: of checkpoints; None saves none.
        config: what a checkpoint says about how the run was configured (plain data).
    """

    def __init__(
        self,
        cfg: TrainerCfg,
        *,
        collector: RolloutCollector,
        update: Update,
        evaluator: Evaluator | None = None,
        solved_at: float | None = None,
        loggers: Sequence[MetricLogger] = (),
        hooks: Sequence[Hook] = (),
        folder: Path | None = None,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        self.cfg, self.collector, self.update = cfg, collector, update
        self.evaluator, self.solved_at = evaluator, solved_at
        self.loggers, self.folder, self.config = loggers, folder, dict(config or {})
        self.iteration, self.saved_at = 0, -1
        self.metrics: dict[str, float] = {}
        self.evaluation: Evaluation | None = None
        self.interrupt = InterruptRequest()
        self.clock = RunClock()
        self.progress = RunProgress(cfg.num_iterations, enabled=False)
        self._own_hooks = tuple(hooks)
        judge = [EvaluationHook(evaluator, interval=cfg.eval_interval)] if evaluator is not None else []
        self._hooks = (*judge, *hooks, CheckpointHook(interval=cfg.checkpoint_interval))
        self._overlaps = update.device.type == "cuda" if cfg.overlap is None else cfg.overlap
        self._unread: list[tuple[int, PendingMetrics]] = []
        self._target_met = False
        self._warned: set[str] = set()

    @property
    def env_states(self) -> int:
        """Env states collected so far."""
        return self.iteration * self.update.num_env_states

    @property
    def solved(self) -> bool | None:
        """Whether the last evaluation reached the task's threshold; None where there is no such thing."""
        if self.solved_at is None or self.evaluation is None:
            return None
        return self.evaluation.return_mean >= self.solved_at

    def train(self, progress: RunProgress | None = None) -> Outcome:
        """Run until all iterations are done, the task is solved, a target is met, or a signal asks to stop.

        The first SIGINT or SIGTERM ends the run after the current iteration, with everything saved.

        Raises:
            NonFiniteStepsError: if gradient steps stay non-finite.
        """
        self.progress = progress or self.progress
        with self.interrupt, self.progress:
            for text in missing_parts(self.collector.env):
                self.progress.note(text)
            try:
                while not self._is_over():
                    self.iterate()
                    for hook in self._due_hooks():
                        self.settle()
                        hook(self)
                self.settle()
                for hook in self._hooks:
                    hook.at_end(self)
            finally:
                for logger in self.loggers:
                    self._ask(logger, logger.close)
        return self._outcome()

    def iterate(self) -> None:
        """Run one iteration: collect a rollout, learn from it, and report what happened.

        Where iterations overlap, what is reported is the iteration before.
        """
        rollout_ET = self.collector.collect()
        self.update(rollout_ET)
        self.iteration += 1
        self._unread.append((self.iteration, self._start_reading(rollout_ET)))
        self._report(all_but=1 if self._overlaps else 0)

    def settle(self) -> None:
        """Wait until the device has done all that it was asked for, and report it."""
        self._report(all_but=0)

    def log(self, figures: Mapping[str, float]) -> None:
        """Add figures of the present iteration to its metrics, and write them to the loggers."""
        self.metrics |= figures
        self._write({"iteration": self.iteration, **figures}, self.iteration)
        self._look_at_target()

    def _is_over(self) -> bool:
        stop = self.cfg.stop_when_solved and self.solved
        return (
            self.iteration >= self.cfg.num_iterations
            or bool(stop)
            or self._target_met
            or bool(self.interrupt)
        )

    def _due_hooks(self) -> list[Hook]:
        return [hook for hook in self._hooks if hook.interval and self.iteration % hook.interval == 0]

    def _start_reading(self, rollout_ET: TensorDictBase) -> PendingMetrics:
        env = self.collector.env
        metrics = read_episode_sums(env, rollout_ET) | read_physics(env) | self.update.metrics()
        return start_copy(metrics, device=self.update.device)

    def _report(self, *, all_but: int) -> None:
        while len(self._unread) > all_but:
            iteration, pending = self._unread.pop(0)
            self._report_iteration(iteration, pending.read())

    def _report_iteration(self, iteration: int, read: dict[str, float]) -> None:
        env, seconds = self.collector.env, self.clock.lap()
        clock = part(env, EpisodeClock)
        physics = explain_physics(env, read)
        for text in physics.saved:
            self.progress.note(f"NaN guard: {text}")
        self._warn(physics.lost, read, iteration)
        self.update.check(read)
        self.metrics = episode_means(
            without_counts(read), max_episode_length_s=0.0 if clock is None else clock.max_episode_length_s
        )
        self.metrics |= physics.metrics | {
            "iteration": iteration,
            "seconds": self.clock.total,
            "throughput/env_states_per_s": self.update.num_env_states / seconds,
        }
        if iteration % self.cfg.log_interval == 0 or iteration == self.cfg.num_iterations:
            self._write(self.metrics, iteration)
        self._look_at_target()

    def _write(self, metrics: dict[str, float], iteration: int) -> None:
        env_states = iteration * self.update.num_env_states
        for logger in self.loggers:
            self._ask(logger, logger.log_metrics, metrics, env_states)
        self.progress.update(
            iteration,
            {"env_states": env_states, **metrics},
            seconds_left=self.clock.seconds_left(self.cfg.num_iterations - iteration),
        )

    def _ask(self, logger: MetricLogger, call: Callable[..., Any], *arguments: Any) -> None:
        """Call a logger; a full disk or a server that is gone costs what it would have written, not the run."""
        try:
            call(*arguments)
        except Exception as error:
            name = type(logger).__name__
            if name not in self._warned:
                self._warned.add(name)
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                self.progress.note(
                    f"warning: the logger {name} failed at iteration {self.iteration}: {reason}; the run goes on "
                    "(said once)"
                )

    def _look_at_target(self) -> None:
        targets = self.cfg.stop_at or {}
        reached = [self.metrics.get(name, float("-inf")) >= value for name, value in targets.items()]
        self._target_met |= bool(targets) and all(reached)
        for name in targets:
            known = name in self.metrics or name.startswith("evaluation/")
            if not known and "episode/return" in self.metrics and name not in self._warned:
                self._warned.add(name)
                self.progress.note(
                    f"warning: stop_at names {name!r}, which no metric is called: {near(name, self.metrics)}"
                )

    def _warn(self, losses: Sequence[str], metrics: Mapping[str, float], iteration: int) -> None:
        """Say what went wrong in this iteration, each kind once; the counts stay in the metrics."""
        texts = {
            text.split(":")[0].split(" needed")[0]: f"PHYSICS LOST CONTACTS OR CONSTRAINTS: {text}"
            for text in losses
        }
        if failed := metrics.get("sum/termination/non_finite"):
            texts["non_finite"] = (
                f"{failed:.0f} envs ended with non-finite physics or actions; they were reset"
            )
        if skipped := metrics["update/skipped_steps"]:
            texts["skipped"] = f"{skipped:.0f} gradient steps were not finite and were skipped"
        for kind, text in texts.items():
            if kind not in self._warned:
                self._warned.add(kind)
                self.progress.note(f"warning: {text} (iteration {iteration}; said once)")

    def _outcome(self) -> Outcome:
        return Outcome(
            iteration=self.iteration,
            env_states=self.env_states,
            seconds=self.clock.total,
            evaluation=self.evaluation,
            solved=self.solved,
            target_met=self._target_met if self.cfg.stop_at else None,
            interrupted_by=self.interrupt.signal,
        )

    # -- state ---------------------------------------------------------------------------------------------------

    def save(self) -> Path:
        """Write a checkpoint of everything that the next iteration depends on.

        Raises:
            OSError: when the disk is full or not writable; earlier checkpoints stay as they are.
        """
        assert self.folder is not None
        with self.clock.paused():
            path = checkpoint.save(
                self.folder,
                self.state_dict(),
                iteration=self.iteration,
                config=self.config,
                keep=self.cfg.keep_checkpoints,
            )
        self.saved_at = self.iteration
        return path

    def load(self, path: Path) -> None:
        """Continue from a checkpoint: a run folder (its newest), a checkpoint folder, or one checkpoint.

        Raises:
            CheckpointError: when it is absent or damaged.
            ValueError: when it belongs to a run with other networks or another env.
        """
        self.load_state_dict(checkpoint.load(checkpoint.latest(path)).state)

    def load_weights(self, path: Path) -> None:
        """Start from the networks and normalizers of a checkpoint, whatever its task was; all else stays new.

        Raises:
            CheckpointError: when it is absent or damaged.
            ValueError: when its networks or the observations that they read are others.
        """
        state = checkpoint.load(checkpoint.latest(path)).state
        checkpoint.check_columns(state["observation_columns"], observation_columns(self.collector.env))
        try:
            self.update.load_weights(state["update"])
        except KeyError as error:
            raise ValueError(f"{path}: of another algorithm: it has no network {error}") from error
        except ValueError as error:
            raise ValueError(
                f"{path}: its networks are others: {error}; choose objective and modules as the "
                "config.yaml of its run has them"
            ) from error

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next iteration depends on: tensors and plain data, nested."""
        return {
            "iteration": self.iteration,
            "seconds": self.clock.total,
            "update": self.update.state_dict(),
            "collector": self.collector.state_dict(),
            "env": dict(self.collector.env.state_dict()),
            "observation_columns": observation_columns(self.collector.env),
            "random": random_state(self.update.device),
            "hooks": {str(index): hook.state_dict() for index, hook in enumerate(self._own_hooks)},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where `state_dict` was taken.

        Raises:
            ValueError: if it is of a run whose networks or observations are others.
        """
        checkpoint.check_columns(state["observation_columns"], observation_columns(self.collector.env))
        if len(state["hooks"]) != len(self._own_hooks):
            raise ValueError(
                f"the checkpoint is of a run with {len(state['hooks'])} hooks, and this one has {len(self._own_hooks)}"
            )
        # A first reset allocates what the collector and the transforms keep, before the saved values go in.
        self.collector.reset()
        self.update.load_state_dict(state["update"])
        try:
            self.collector.env.load_state_dict(state["env"])
        except RuntimeError as error:  # what torch raises for names and shapes
            reason = " ".join(str(error).split())
            raise ValueError(
                f"the checkpoint is of another env, or of one that an earlier ksim_rl built: {reason} Its networks may "
                "still fit: ksim-rl train checkpoint=RUN"
            ) from error
        self.collector.load_state_dict(state["collector"])
        for index, hook in enumerate(self._own_hooks):
            hook.load_state_dict(state["hooks"][str(index)])
        self.iteration = self.saved_at = state["iteration"]
        self.clock.total = state["seconds"]
        load_random_state(state["random"], self.update.device)


def random_state(device: torch.device) -> dict[str, UInt8[Tensor, "?L"]]:
    """Return the state of the default generators of the host and of `device`."""
    state = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def load_random_state(state: Mapping[str, UInt8[Tensor, "?L"]], device: torch.device) -> None:
    """Continue the default generators; a run that moves to another kind of device keeps that one's present state."""
    torch.set_rng_state(state["cpu"])
    if device.type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)
