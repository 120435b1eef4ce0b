"""How a run ended."""

import signal
from dataclasses import dataclass

from ksim_rl.trainers.evaluation import Evaluation


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a run ended."""

    iteration: int
    env_states: int
    seconds: float
    evaluation: Evaluation | None
    solved: bool | None  # None where the task has no threshold, or nothing was evaluated
    target_met: bool | None  # None where no target was set
    interrupted_by: signal.Signals | None
    why: str = ""  # it ended
