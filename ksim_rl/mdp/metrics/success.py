"""These metrics say which share of the episodes did what it should, in [0, 1]."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.checks import unknown_name
from ksim_rl.envs.term import MetricTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.target_pose import OfTarget


@dataclass(frozen=True, kw_only=True)
class Success(MetricTerm):
    """1 where the episode ends by one of the named terminations and by no other, else 0, [E].

    With the time-out it is the share of episodes that survived. Envs that are not made of terms have `SuccessTracker`.

    Attributes:
        terminations: names in the env's `terminations`.
    """

    terminations: tuple[str, ...]
    reduce: Literal["mean", "last", "max", "sum"] = "last"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.terminations:
            raise ValueError("terminations=(): name at least one, such as ('time_out',)")

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        for name in self.terminations:
            if name not in view.terminations:
                raise unknown_name("termination", name, view.terminations)
        wanted = [flag_E for name, flag_E in view.terminations.items() if name in self.terminations]
        others = [flag_E for name, flag_E in view.terminations.items() if name not in self.terminations]
        succeeds_E = torch.stack(wanted).any(0)
        if others:
            succeeds_E = succeeds_E & ~torch.stack(others).any(0)
        return succeeds_E.to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class TargetReached(OfTarget, MetricTerm):
    """1 while a body or site is within a tolerance of the position that a `CartesianCommand` asks for, else 0.

    Position stage, with the command that the policy saw. `reduce="last"` (the default) asks whether it is there in the
    end, "max" whether it ever was, "mean" for which share of the time.

    Attributes:
        tolerance: m.
    """

    tolerance: Positive
    reduce: Literal["mean", "last", "max", "sum"] = "last"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (self.distance(view) <= self.tolerance).to(torch.float32)
