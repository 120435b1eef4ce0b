"""This module configures how long a run is, and what happens beside learning."""

from collections.abc import Mapping
from dataclasses import dataclass

from ksim_rl.checks import check_choice, check_count, check_in_range

MATMUL_PRECISIONS = ("highest", "high", "medium")
MOST_THREADS = 1024


@dataclass(frozen=True, kw_only=True)
class TrainerCfg:
    """Options of `Trainer`. Intervals are in iterations; 0 means never.

    Attributes:
        num_iterations: an iteration is one rollout and one update, D env states.
        eval_interval: between evaluations with deterministic actions in envs of their own.
        eval_episodes: episodes of an evaluation, one env each; 0 means no evaluation at all.
        stop_when_solved: end the run as soon as an evaluation reaches the task's threshold.
        stop_at: end the run as soon as each of these metrics reaches its value in one and the same iteration, such as
            `{"reward/track_linear_velocity": 1.39}`; figures of evaluations count as well. None has no such targets.
        checkpoint_interval: between checkpoints; the last iteration is always saved.
        keep_checkpoints: how many of the newest checkpoints stay.
        log_interval: between rows of the logs and lines of progress.
        overlap: read the metrics of an iteration while the next one runs; None does so on CUDA. Where nothing else
            asks for them earlier, `stop_at` and the guards then act one iteration later. What is learned, logged and
            saved is the same.
        num_threads: torch's threads on the CPU; None leaves one core free, and takes eight at most for a run on CUDA. A
            thread that has to wait for a core that is busy elsewhere stalls all others: on two cores that made runs
            beside other work twenty times slower.
        matmul_precision: of float32 products on CUDA; "high" is TF32.
        video: record the final policy.
        video_s: seconds of it.
    """

    num_iterations: int = 100
    eval_interval: int = 20
    eval_episodes: int = 100
    stop_when_solved: bool = True
    stop_at: Mapping[str, float] | None = None
    checkpoint_interval: int = 20
    keep_checkpoints: int = 3
    log_interval: int = 1
    overlap: bool | None = None
    num_threads: int | None = None
    matmul_precision: str = "high"
    video: bool = True
    video_s: float = 10.0

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        for name, low in (
            ("num_iterations", 1),
            ("eval_interval", 0),
            ("eval_episodes", 0),
            ("checkpoint_interval", 0),
            ("keep_checkpoints", 1),
            ("log_interval", 1),
        ):
            check_count(name, getattr(self, name), low=low)
        for name, value in (self.stop_at or {}).items():
            check_in_range(f"stop_at.{name}", value)
        if self.num_threads is not None:
            # Where threads cannot be made, torch ends the process instead of raising.
            check_in_range("num_threads", self.num_threads, low=1, high=MOST_THREADS)
        check_choice("matmul_precision", self.matmul_precision, MATMUL_PRECISIONS)
        check_in_range("video_s", self.video_s, low=0.0, low_open=True)
