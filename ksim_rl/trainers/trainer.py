"""The training loop collects and learns in turn; hooks evaluate, save, and run users' code between iterations."""

import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from ksim_rl import ranks
from ksim_rl.checks import near
from ksim_rl.collectors import RolloutCollector
from ksim_rl.device.state_tree import branch, number
from ksim_rl.diagnosis.probes import probed
from ksim_rl.envs.contract import EpisodeClock, missing_parts, part
from ksim_rl.envs.recorded_python import FrozenPythonError
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.algorithm import HasProgress, State, Update, notes_of
from ksim_rl.trainers.evaluation import Evaluation, Evaluator
from ksim_rl.trainers.hook_states import paired
from ksim_rl.trainers.interrupt import InterruptRequest
from ksim_rl.trainers.loggers import MetricLogger
from ksim_rl.trainers.metrics import (
    ADDED,
    MOST,
    PendingMetrics,
    episode_means,
    explain_physics,
    losses_of,
    read_episode_sums,
    read_physics,
    start_copy,
)
from ksim_rl.trainers.outcome import Outcome
from ksim_rl.trainers.progress import RunClock, RunProgress
from ksim_rl.trainers.restoring import (
    load_env_state,
    load_networks,
    load_random_state,
    random_state,
)
from ksim_rl.trainers.run_cfg import TrainerCfg
from ksim_rl.trainers.said_once import SaidOnce
from ksim_rl.trainers.suspect_iterations import with_iterations
from ksim_rl.transforms import observation_columns

INTERRUPTED = "sum/interrupted"  # how many ranks were asked to stop


class Hook:
    """Something to do between iterations: an evaluation, a schedule of your own, a message to a user.

    When a hook is called, the device has done all queued work, `trainer.metrics` are the present iteration's, and the
    hook may change anything. CUDA graphs keep the numbers that they were captured with, and are captured again where
    these have changed, which takes time. Numbers that change often, such as a learning rate, should be tensors that
    the graphs read: `copy_` into those. Example:

        class Annealing(Hook):
            interval = 10

            def __call__(self, trainer):
                for group in trainer.update.optimizer.param_groups:
                    group["lr"].mul_(0.9)

    Attributes:
        interval: iterations between calls; 0 is only at the end. Before a call the host waits for the device, so on a
            GPU an interval of 1 keeps an iteration from starting while the metrics of the last one are written.
    """

    interval: int = 1

    def __call__(self, trainer: "Trainer") -> None:
        """Act after the iterations whose number `interval` divides."""

    def at_end(self, trainer: "Trainer") -> None:
        """Act once after the last iteration, also of an interrupted run."""

    def state_dict(self) -> State:
        """Return the state that later calls depend on: tensors and plain data, nested; a checkpoint keeps it."""
        return {}

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken."""


class EvaluationHook(Hook):
    """Evaluates the policy in separate envs, probes the networks in the last rollout, and logs the figures."""

    def __init__(self, evaluator: Evaluator, *, interval: int) -> None:
        self.evaluator = evaluator
        self.interval = interval
        self._evaluated_at: int | None = None

    def __call__(self, trainer: "Trainer") -> None:
        """Evaluate, unless a signal asks to stop meanwhile."""
        episodes = self.evaluator.env.batch_size[0] * ranks.size()
        with trainer.clock.paused(), trainer.progress.busy(f"evaluating over {episodes} episodes"):
            evaluation = self.evaluator(stop=lambda: ranks.size() == 1 and bool(trainer.interrupt))
        if evaluation is None:  # it was asked to stop
            return
        losses = losses_of(self.evaluator.env)
        for text in losses.lines:
            trainer.progress.note(f"warning: evaluation at iteration {trainer.iteration}: {text}")
        trainer.evaluation = evaluation = replace(evaluation, lost_worlds=losses.worlds)
        self._evaluated_at = trainer.iteration  # so that the end is not evaluated twice
        figures = {f"evaluation/{name}": value for name, value in asdict(evaluation).items()}
        trainer.log(figures | probed(trainer.update, trainer.collector.env, trainer.rollout_ET))

    def at_end(self, trainer: "Trainer") -> None:
        """Evaluate the final policy, once."""
        if not trainer.interrupted and self._evaluated_at != trainer.iteration:
            self(trainer)


class CheckpointHook(Hook):
    """Saves everything that the next iteration depends on. A full disk costs a checkpoint, not the run."""

    def __init__(self, *, interval: int) -> None:
        self.interval = interval

    def __call__(self, trainer: "Trainer") -> None:
        """Save, or say why not."""
        if trainer.folder is None:  # a run that saves nothing
            return
        try:
            trainer.save()
        except OSError as error:
            trainer.progress.note(
                f"warning: no checkpoint at iteration {trainer.iteration}: {error}; the run goes on"
            )

    def at_end(self, trainer: "Trainer") -> None:
        """Save the end, which must not fail in silence."""
        if trainer.folder is not None and trainer.saved_at != trainer.iteration:
            try:
                trainer.save()
            except OSError as error:
                raise OSError(
                    f"{trainer.folder}: no checkpoint of the end, iteration {trainer.iteration}: {error}; make room or "
                    "let it be written, and resume the run from the last one"
                ) from error


class Trainer:
    """The training loop: collects and learns, and logs, evaluates and saves meanwhile.

    The metrics of an iteration come to the host in one copy. On CUDA they are read while the next iteration runs, so
    that the device never waits for logs; before a hook is called the run is settled first.

    Without an `evaluator` nothing is evaluated; `solved_at` is of its mean return. The `hooks` run after an evaluation
    and before a checkpoint. A checkpoint in `folder` (None saves none) holds `config`, plain data, as the run's.
    Set `loggers` to record the metrics, and `notes` to texts of how things were built, which training begins by saying.
    """

    def __init__(
        self,
        cfg: TrainerCfg,
        *,
        collector: RolloutCollector,
        update: Update,
        evaluator: Evaluator | None = None,
        solved_at: float | None = None,
        hooks: Sequence[Hook] = (),
        folder: Path | None = None,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        self.cfg = cfg
        self.collector = collector
        self.update = update
        self.evaluator = evaluator
        self.solved_at = solved_at
        self.loggers: Sequence[MetricLogger] = ()
        self.folder = folder
        self.config = dict(config or {})
        self.iteration = 0
        self.saved_at = -1
        self.metrics: dict[str, float] = {}
        self.rollout_ET: Any = None  # the last one
        self.warm_up_s = 0.0  # of compiling and capturing before training; not in `clock.total`
        self.evaluation: Evaluation | None = None
        self.interrupt = InterruptRequest()
        self.clock = RunClock()
        self.progress = RunProgress(cfg.num_iterations, enabled=False)
        # Called in each iteration, before anything is written.
        self.watch: Callable[[], None] = lambda: None
        self.notes: Sequence[str] = ()
        self._own_hooks = tuple(hooks)
        self._hooks: list[Hook] = [*hooks, CheckpointHook(interval=cfg.checkpoint_interval)]
        if evaluator is not None:
            # Judged first, so that a checkpoint of the same iteration has the evaluation.
            self._hooks.insert(0, EvaluationHook(evaluator, interval=cfg.eval_interval))
        if cfg.overlap is None:
            self._overlaps = update.device.type == "cuda"  # on the CPU nothing runs meanwhile
        else:
            self._overlaps = cfg.overlap
        self._unread: list[tuple[int, PendingMetrics]] = []  # oldest first
        self.collecting = ranks.Timing(update.device)
        self._target_met = False
        # Of the progress at that time.
        self._warnings = SaidOnce(lambda text: self.progress.note(text))
        self._told_to_end = False  # by any rank

    @property
    def env_states(self) -> int:
        """Env states collected so far."""
        return self.iteration * self.num_env_states

    @property
    def num_env_states(self) -> int:
        """Env states of an iteration, of all ranks."""
        return self.update.num_env_states * ranks.size()

    @property
    def interrupted(self) -> bool:
        """Whether a signal asks to stop; with several ranks, whether all of them know of one."""
        if ranks.size() > 1:
            return self._told_to_end
        return bool(self.interrupt)

    @property
    def solved(self) -> bool | None:
        """Whether the last evaluation reached the task's threshold; None where there is no such thing."""
        if self.solved_at is None or self.evaluation is None:
            return None
        return self.solved_at <= self.evaluation.return_mean < float("inf")

    def train(self, progress: RunProgress | None = None) -> Outcome:
        """Run until all iterations are done, the task is solved, a target is met, or a signal asks to stop.

        The first SIGINT or SIGTERM ends the run after the current iteration, with everything saved.
        """
        self.progress = progress or self.progress
        with self.interrupt, self.progress:
            notes = (*self.notes, *notes_of(self.update, warm_up=self.cfg.warm_up))
            for text in (*missing_parts(self.collector.env), *notes):  # what this env cannot do
                self.progress.note(text)
            if self.warm_up_s:
                self.progress.note(
                    f"compiled and captured in {self.warm_up_s:.1f} s, before training"
                )
            self.clock.begin()  # compiling before this does not count
            try:
                while not self._is_over():
                    self.iterate()
                    for hook in self._hooks:
                        if hook.interval and self.iteration % hook.interval == 0:
                            self.settle()
                            ranks.at(f"in {type(hook).__name__} after iteration {self.iteration}")
                            hook(self)
                self.settle()
                why = self._why_it_is_over()
                if self.iteration < self.cfg.num_iterations:
                    self.progress.note(
                        f"{why}, stopping after iteration {self.iteration} of {self.cfg.num_iterations}"
                    )
                for hook in self._hooks:
                    hook.at_end(self)
            finally:
                self.collector.close()
                for logger in self.loggers:
                    self._warnings.call(logger, logger.close, iteration=self.iteration)
        return Outcome(
            iteration=self.iteration,
            env_states=self.env_states,
            seconds=self.clock.total,
            evaluation=self.evaluation,
            solved=self.solved,
            target_met=self._target_met if self.cfg.stop_at else None,
            interrupted_by=self.interrupt.signal,
            why=why,
        )

    def iterate(self) -> None:
        """Collect a rollout, learn from it, and report metrics: of the iteration before, where iterations overlap."""
        self.collecting.begin(self.iteration + 1)
        try:
            self.rollout_ET = rollout_ET = self.collector.collect()
        except FrozenPythonError as error:
            raise with_iterations(error, iteration=self.iteration, folder=self.folder) from error
        self.collecting.end()
        if isinstance(self.update, HasProgress):
            self.update.set_progress(min(self.iteration / self.cfg.num_iterations, 1.0))
        self.update(rollout_ET)
        self.iteration += 1
        self.watch()
        env = self.collector.env
        metrics = read_episode_sums(env, rollout_ET) | read_physics(env) | self.update.metrics()
        if ranks.size() > 1:
            metrics[INTERRUPTED] = torch.full(
                (), float(bool(self.interrupt)), device=self.update.device
            )
            metrics = ranks.combined(metrics, added=ADDED, most=MOST)
        self._unread.append((self.iteration, start_copy(metrics, device=self.update.device)))
        self._report(all_but=1 if self._overlaps else 0)

    def settle(self) -> None:
        """Wait until the device has done all queued work, and report it."""
        self._report(all_but=0)

    def log(self, figures: Mapping[str, float]) -> None:
        """Add figures of the present iteration to its metrics, and write them to the loggers."""
        self.metrics |= figures
        self._write({"iteration": self.iteration, **figures}, self.iteration)
        self._look_at_target()

    def _is_over(self) -> bool:
        ended = (
            self._target_met or self.interrupted or bool(self.cfg.stop_when_solved and self.solved)
        )
        return ended or self.iteration >= self.cfg.num_iterations

    def _why_it_is_over(self) -> str:
        if self.interrupt.signal is not None:
            return self.interrupt.signal.name
        if self._target_met:
            targets = (
                f"{name} {self.metrics.get(name, value):.4g}"
                for name, value in (self.cfg.stop_at or {}).items()
            )
            return f"stop_at is met ({', '.join(targets)})"
        if self.cfg.stop_when_solved and self.solved and self.evaluation is not None:
            return (
                f"solved (return {self.evaluation.return_mean:.1f}, threshold {self.solved_at:g})"
            )
        return f"all {self.cfg.num_iterations} iterations are done"

    def _report(self, *, all_but: int) -> None:
        while len(self._unread) > all_but:
            iteration, pending = self._unread.pop(0)
            self._report_iteration(iteration, pending.read())

    def _report_iteration(self, iteration: int, read: dict[str, float]) -> None:
        env = self.collector.env
        seconds = self.clock.lap()
        if read.pop(INTERRUPTED, 0.0):
            self._told_to_end = True  # all ranks read the same sum, and end together
            self.interrupt.signal = self.interrupt.signal or signal.SIGTERM
        clock = part(env, EpisodeClock)
        physics = explain_physics(env, read)  # waits for the device only after a failure
        for text in physics.saved:
            self.progress.note(f"NaN guard: {text}")
        self._warnings.warn_of(physics.lost, read, env=env, iteration=iteration)
        self.update.check(read)  # may end the run: warnings come first
        if clock is None:
            longest_s = 0.0  # rewards are then per episode, not per second
        else:
            longest_s = clock.max_episode_length_s
        # Sums become means of episodes.
        self.metrics = episode_means(read, max_episode_length_s=longest_s)
        self.metrics |= physics.metrics | {
            "iteration": iteration,
            "seconds": self.clock.total,
            **({"warm_up_s": self.warm_up_s} if self.warm_up_s else {}),
            "throughput/env_states_per_s": self.num_env_states / seconds,
            **self.collecting.slowest(),
        }
        if iteration % self.cfg.log_interval == 0 or iteration == self.cfg.num_iterations:
            self._write(self.metrics, iteration)
        self._look_at_target()

    def _write(self, metrics: dict[str, float], iteration: int) -> None:
        env_states = iteration * self.num_env_states
        for logger in self.loggers:
            self._warnings.call(
                logger, logger.log_metrics, metrics, env_states, iteration=self.iteration
            )
        self.progress.update(
            iteration,
            {"env_states": env_states, **metrics},
            seconds_left=self.clock.seconds_left(self.cfg.num_iterations - iteration),
        )

    def _look_at_target(self) -> None:
        targets = self.cfg.stop_at or {}
        reached = [
            self.metrics.get(name, float("-inf")) >= value for name, value in targets.items()
        ]
        self._target_met |= bool(targets) and all(reached)
        for name in targets:
            known = name in self.metrics or name.startswith("evaluation/")
            if not known and "episode/return" in self.metrics:  # else terms have no metrics yet
                self._warnings.warn(
                    name, f"stop_at: {name!r} is no metric: {near(name, self.metrics)}"
                )

    def save(self) -> Path:
        """Write a checkpoint of everything that the next iteration depends on, of all ranks; see `checkpoint.save`."""
        assert self.folder is not None
        self.watch()
        with self.clock.paused():
            path = checkpoint.save(
                self.folder,
                self.state_dict(),
                iteration=self.iteration,
                config=self.config,
                keep=self.cfg.keep_checkpoints,
                trusted=self.iteration - self.collector.unchecked_rollouts,
            )
        self.saved_at = self.iteration  # so that the end is not saved twice
        return path

    def load(self, path: Path) -> None:
        """Continue from a checkpoint: a run folder (its newest), a checkpoint folder, or one checkpoint."""
        self.load_state_dict(checkpoint.load_latest(path).state)

    def load_weights(self, path: Path) -> None:
        """Start from the networks and normalizers of a checkpoint of any task, if they fit here; all else stays new."""
        state = checkpoint.load_latest(path).state
        columns = checkpoint.columns_of(state)
        checkpoint.check_columns(columns, observation_columns(self.collector.env))
        note = load_networks(self.update, branch(state, "update"), path)
        self.notes = [*self.notes, *filter(None, [note])]

    def state_dict(self) -> State:
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

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken; a ValueError where networks, observations or env are others."""
        columns = checkpoint.columns_of(state)
        checkpoint.check_columns(columns, observation_columns(self.collector.env))
        hooks = paired(self._own_hooks, branch(state, "hooks"), keeps=_keeps)
        # A first reset allocates the state of collector and transforms, before the saved values go in.
        self.collector.reset()
        state = checkpoint.own_part(state, self.state_dict)  # of this rank
        self.update.load_state_dict(branch(state, "update"))
        load_env_state(self.collector.env, branch(state, "env"))
        self.collector.load_state_dict(branch(state, "collector"))
        for hook, own in hooks:
            hook.load_state_dict(own)
        self.iteration = self.saved_at = int(number(state, "iteration"))
        self.clock.total = float(number(state, "seconds"))
        load_random_state(
            branch(state, "random"), self.update.device
        )  # last: the steps above may draw


def _keeps(hook: Hook) -> bool:
    return type(hook).state_dict is not Hook.state_dict
