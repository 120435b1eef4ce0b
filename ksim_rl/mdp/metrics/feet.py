"""These metrics say how feet move, and what they press with.

Poses and velocities are of the current state; contacts and forces belong to the last physics substep (acceleration
stage).
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.term import MetricTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfFeet
from ksim_rl.mdp.quantities import contact_force
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class FootSlipSpeed(OfFeet, MetricTerm):
    """Mean over the feet in contact of their horizontal speed, world frame, m/s; 0 while none touches."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        found_EF = self.contact(view).found_EN
        speed_EF = torch.linalg.vector_norm(view.sites(self.sites).lin_vel_EN3[..., :2], dim=-1)
        return (speed_EF * found_EF).sum(-1) / found_EF.sum(-1).clamp(min=1.0)


@dataclass(frozen=True, kw_only=True)
class PeakFootHeight(MetricTerm):
    """Height of the highest foot above the ground below it, m, [E]; by default its greatest value in the episode.

    Attributes:
        sites: the feet.
    """

    sites: Patterns
    reduce: Literal["mean", "last", "max", "sum"] = "max"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.sites(self.sites).height_EN.amax(-1)


@dataclass(frozen=True, kw_only=True)
class PeakContactForce(MetricTerm):
    """Magnitude of the greatest net contact force, N, [E]; by default its greatest value in the episode.

    It is sampled once per env step, at its last physics substep: an impact may have been harder.

    Attributes:
        sensor: a contact sensor of `scene.sensors`.
    """

    sensor: str
    reduce: Literal["mean", "last", "max", "sum"] = "max"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return the value of the last substep, [E]."""
        return contact_force(view, self.sensor).amax(-1)
