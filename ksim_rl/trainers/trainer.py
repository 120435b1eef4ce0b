"""The training loop."""

import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from ksim_rl.collectors import RolloutCollector
from ksim_rl.envs.innermost import innermost
from ksim_rl.envs.transforms import observation_columns
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.episode_metrics import (
    episode_means,
    nan_messages,
    overflow_report,
    read_episode_sums,
)
from ksim_rl.trainers.evaluation import Evaluation, Evaluator
from ksim_rl.trainers.interrupt import InterruptRequest
from ksim_rl.trainers.loggers import MetricLogger
from ksim_rl.trainers.metrics import start_copy
from ksim_rl.trainers.progress import RunProgress
from ksim_rl.trainers.run_clock import RunClock
from ksim_rl.trainers.run_state import load_random_state, random_state
from ksim_rl.trainers.trainer_cfg import TrainerCfg
from ksim_rl.trainers.update import Update


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a run ended. `solved` is None where the task has no threshold or nothing was evaluated."""

    iteration: int
    env_states: int
    seconds: float
    evaluation: Evaluation | None
    solved: bool | None
    interrupted_by: signal.Signals | None


class Trainer:
    """Collects, learns, and beside that logs, evaluates and saves.

    Args:
        cfg: how long, and how often what.
        collector: gives the rollouts; its env is the one that is trained in.
        update: improves the networks with a rollout.
        evaluator: judges the policy; None never evaluates.
        solved_at: the mean evaluation return that counts as solved.
        loggers: take the metrics.
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
        folder: Path | None = None,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        self.cfg, self.collector, self.update = cfg, collector, update
        self.evaluator, self.solved_at = evaluator, solved_at
        self.loggers, self.folder, self.config = loggers, folder, dict(config or {})
        self.iteration = 0
        self.evaluation: Evaluation | None = None
        self.interrupt = InterruptRequest()
        self.clock = RunClock()
        self.progress = RunProgress(cfg.num_iterations, enabled=False)
        self._evaluated_at = self._saved_at = -1
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
        """Run until all iterations are done, the task is solved, or a signal asks to stop.

        The first SIGINT or SIGTERM ends the run after the current iteration, with everything saved.

        Raises:
            NonFiniteStepsError: if gradient steps stay non-finite.
        """
        self.progress = progress or self.progress
        with self.interrupt, self.progress:
            try:
                while not self._is_over():
                    self.iterate()
                    self._evaluate_if_due()
                    self._save_if_due()
                self._finish()
            finally:
                for logger in self.loggers:
                    logger.close()
        return self._outcome()

    def iterate(self) -> None:
        """Run one iteration: collect a rollout, learn from it, and report what happened."""
        rollout_ET = self.collector.collect()
        self.update(rollout_ET)
        self._report(rollout_ET)

    def _is_over(self) -> bool:
        stop = self.cfg.stop_when_solved and self.solved
        return self.iteration >= self.cfg.num_iterations or bool(stop) or bool(self.interrupt)

    def _report(self, rollout_ET: TensorDictBase) -> None:
        env = self.collector.env
        pending = start_copy(
            read_episode_sums(env, rollout_ET) | self.update.metrics(), device=self.update.device
        )
        physics, losses = overflow_report(env)
        saved = nan_messages(env)
        metrics = pending.read()
        self.iteration += 1
        seconds = self.clock.lap()

        self._warn(losses, metrics)
        for text in saved:
            self.progress.note(f"NaN guard: {text}")
        self.update.check(metrics)
        metrics = episode_means(
            metrics, max_episode_length_s=getattr(innermost(env), "max_episode_length_s", 0.0)
        )
        metrics |= physics | {
            "iteration": self.iteration,
            "seconds": self.clock.total,
            "throughput/env_states_per_s": self.update.num_env_states / seconds,
        }
        if self.iteration % self.cfg.log_interval == 0 or self.iteration == self.cfg.num_iterations:
            self._log(metrics)

    def _log(self, metrics: dict[str, float]) -> None:
        for logger in self.loggers:
            logger.log_metrics(metrics, self.env_states)
        self.progress.update(
            self.iteration,
            {"env_states": self.env_states, **metrics},
            seconds_left=self.clock.seconds_left(self.cfg.num_iterations - self.iteration),
        )

    def _warn(self, losses: Sequence[str], metrics: Mapping[str, float]) -> None:
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
                self.progress.note(f"warning: {text} (iteration {self.iteration}; said once)")

    def _evaluate_if_due(self) -> None:
        interval = self.cfg.eval_interval
        if self.evaluator is not None and interval and self.iteration % interval == 0:
            self._evaluate(self.evaluator)

    def _evaluate(self, evaluator: Evaluator) -> None:
        with self.clock.paused():
            evaluation = evaluator(stop=self.interrupt.__bool__)
        if evaluation is None:
            return
        self.evaluation, self._evaluated_at = evaluation, self.iteration
        figures = {f"evaluation/{name}": value for name, value in evaluation.as_dict().items()}
        self._log({"iteration": self.iteration, **figures})

    def _save_if_due(self) -> None:
        interval = self.cfg.checkpoint_interval
        if self.folder is not None and interval and self.iteration % interval == 0:
            try:
                self.save()
            except OSError as error:
                self.progress.note(
                    f"warning: no checkpoint at iteration {self.iteration}: {error}; the run goes on"
                )

    def _finish(self) -> None:
        if self.evaluator is not None and not self.interrupt and self._evaluated_at != self.iteration:
            self._evaluate(self.evaluator)
        if self.folder is not None and self._saved_at != self.iteration:
            self.save()

    def _outcome(self) -> Outcome:
        return Outcome(
            iteration=self.iteration,
            env_states=self.env_states,
            seconds=self.clock.total,
            evaluation=self.evaluation,
            solved=self.solved,
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
        self._saved_at = self.iteration
        return path

    def load(self, path: Path) -> None:
        """Continue from a checkpoint: a run folder (its newest), a checkpoint folder, or one checkpoint.

        Raises:
            CheckpointError: when it is absent or damaged.
            ValueError: when it belongs to a run with other networks or another env.
        """
        self.load_state_dict(checkpoint.load(checkpoint.latest(path)).state)

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
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where `state_dict` was taken.

        Raises:
            ValueError: if it is of a run whose networks or observations are others.
        """
        columns = observation_columns(self.collector.env)
        if state["observation_columns"] != columns:
            raise ValueError(
                f"the checkpoint's observations have the columns {state['observation_columns']}, "
                f"and this run's {columns}"
            )
        # A first reset allocates what the collector and the transforms keep, before the saved values go in.
        self.collector.reset()
        self.update.load_state_dict(state["update"])
        self.collector.env.load_state_dict(state["env"])
        self.collector.load_state_dict(state["collector"])
        self.iteration = self._saved_at = state["iteration"]
        self.clock.total = state["seconds"]
        load_random_state(state["random"], self.update.device)
