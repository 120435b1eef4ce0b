"""The settings of distillation."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.objectives.algorithm_cfg import AlgorithmCfg
from ksim_rl.objectives.ppo_cfg import check_schedule

LOSSES = ("kl", "mse")


@dataclass(frozen=True, kw_only=True)
class DistillationCfg(AlgorithmCfg):
    """A student learns to act as a teacher does in the states that the student itself visits.

    That is DAgger (Ross et al., arXiv 1011.0686) without its aggregate of all data: the newest rollout of thousands of
    envs stands for it.

    Attributes:
        teacher: a run folder or a checkpoint, whose policy is the teacher.
        loss: "kl", the divergence of the student's distribution from the teacher's, which also learns how actions
            scatter; or "mse", of the actions that both take deterministically, without noise while the student
            collects, for teachers without a distribution or with another kind of it.
        num_epochs: passes over each rollout.
        teacher_share: the chance that the teacher acts instead of the student, in each env state of the first rollout.
        teacher_share_decay: factor of it from rollout to rollout.
        learning_rate: of Adam, at the start; within its bounds if the schedule is adaptive.
        schedule: "fixed", or "adaptive", which changes it after each gradient step so that the divergence of the
            student from the one that collected the rollout stays near `desired_kl`.
        desired_kl: in nats.
        learning_rate_min, learning_rate_max: bounds of the adaptive schedule.
        max_grad_norm: bound on the norm of the gradient; None does not clip.
        betas, adam_eps, weight_decay: of Adam.
        max_skipped_steps: so many gradient steps in a row that are not finite end the run.
    """

    learns_on_sequences: ClassVar[bool] = True

    teacher: str = ""
    loss: str = "kl"
    num_epochs: int = 2
    teacher_share: float = 0.0
    teacher_share_decay: float = 0.95
    learning_rate: float = 1e-3
    schedule: str = "fixed"
    desired_kl: float = 0.01
    learning_rate_min: float = 1e-5
    learning_rate_max: float = 1e-2
    max_grad_norm: float | None = 1.0
    betas: tuple[float, float] = (0.9, 0.999)
    adam_eps: float = 1e-8
    weight_decay: float = 0.0
    max_skipped_steps: int = 100

    def with_absolute_paths(self) -> Self:
        """Return the same settings, whose teacher is found from any folder."""
        return replace(self, teacher=str(Path(self.teacher).resolve()))

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "betas", tuple(self.betas))
        if not self.teacher:
            raise ValueError("teacher='': name a run folder or a checkpoint, objective.teacher=RUN")
        check_choice("loss", self.loss, LOSSES)
        for field in ("num_epochs", "max_skipped_steps"):
            value = getattr(self, field)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{field}={value!r}: expected a whole number >= 1")
        for field in ("teacher_share", "teacher_share_decay"):
            check_in_range(field, getattr(self, field), low=0.0, high=1.0)
        for field in ("learning_rate", "desired_kl", "learning_rate_min", "learning_rate_max", "adam_eps"):
            check_in_range(field, getattr(self, field), low=0.0, low_open=True)
        check_in_range("weight_decay", self.weight_decay, low=0.0)
        if self.max_grad_norm is not None:
            check_in_range("max_grad_norm", self.max_grad_norm, low=0.0, low_open=True)
        if len(self.betas) != 2 or not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise ValueError(f"betas={self.betas!r}: expected two numbers in [0, 1)")
        check_schedule(
            self.schedule, self.learning_rate, low=self.learning_rate_min, high=self.learning_rate_max
        )
