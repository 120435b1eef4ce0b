"""This module holds the settings of distillation."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.objectives.algorithm_cfg import OnPolicyCfg

LOSSES = ("kl", "mse")


@dataclass(frozen=True, kw_only=True)
class DistillationCfg(OnPolicyCfg):
    """A student learns to act as a teacher does in the states that the student itself visits.

    That is DAgger (Ross et al., arXiv 1011.0686) without its aggregate of all data: the newest rollout of thousands of
    envs stands for it.

    Attributes:
        teacher: a run folder or a checkpoint, whose policy is the teacher.
        loss: "kl", the divergence of the student's distribution from the teacher's, which also learns how actions
            scatter; or "mse", of the actions that both take deterministically, without noise while the student
            collects, for teachers without a distribution or with another kind of it.
        teacher_share: the chance that the teacher acts instead of the student, in each env state of the first rollout.
        teacher_share_decay: factor of it from rollout to rollout.
    """

    teacher: str = ""
    loss: str = "kl"
    num_epochs: int = 2
    teacher_share: float = 0.0
    teacher_share_decay: float = 0.95

    def with_absolute_paths(self) -> Self:
        """Return the same settings, whose teacher is found from any folder."""
        return replace(self, teacher=str(Path(self.teacher).resolve()))

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        if not self.teacher:
            raise ValueError("teacher='': name a run folder or a checkpoint, objective.teacher=RUN")
        check_choice("loss", self.loss, LOSSES)
        for field in ("teacher_share", "teacher_share_decay"):
            check_in_range(field, getattr(self, field), low=0.0, high=1.0)
