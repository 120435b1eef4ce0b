"""Observation terms of contacts and feet, float32 [E, L].

Contacts and their forces are those of the last physics substep (acceleration stage), in the order of the sensor's
elements; poses and velocities are of the current state.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.observations.framed_observation import FramedObservation
from ksim_rl.scene.names import Patterns

# -- any contact sensor ------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Contact(ObservationTerm):
    """1 where the net contact force exceeds a threshold, else 0, [E, N]; acceleration stage.

    Attributes:
        sensor: a contact sensor of `scene.sensors`.
        threshold: N.
    """

    sensor: str
    threshold: float = 0.0

    def __post_init__(self) -> None:
        check_in_range("threshold", self.threshold, low=0.0)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        force_EN = torch.linalg.vector_norm(view.contact(self.sensor).force_EN3, dim=-1)
        return (force_EN > self.threshold).to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class ContactForce(FramedObservation):
    """Net contact forces, N, [E, 3N]; acceleration stage. MuJoCo's sign: what weighs on the ground reads negative z.

    Attributes:
        sensor: a contact sensor of `scene.sensors`.
    """

    sensor: str
    frame: Literal["root", "world"] = "world"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return self.vectors(view, view.contact(self.sensor).force_EN3)


# -- feet --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FootPos(FramedObservation):
    """Positions of sites, m, [E, 3F]; position stage."""

    sites: Patterns

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return self.points(view, view.sites(self.sites).pos_EN3)


@dataclass(frozen=True, kw_only=True)
class FootHeight(ObservationTerm):
    """Heights of sites above the ground right below them, m, [E, F]; position stage."""

    sites: Patterns

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.sites(self.sites).height_EN


@dataclass(frozen=True, kw_only=True)
class FootAirTime(ObservationTerm):
    """Seconds since each foot left the ground, 0 while it touches, [E, F]; acceleration stage."""

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.contact(self.sensor).air_time_EN


@dataclass(frozen=True, kw_only=True)
class FootContact(ObservationTerm):
    """1 where a foot touches the ground, else 0, [E, F]; acceleration stage."""

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.contact(self.sensor).found_EN


@dataclass(frozen=True, kw_only=True)
class FootContactForces(ObservationTerm):
    """Net force of each foot on the ground, world frame, sign(f) log(1 + |f|) of newtons, [E, 3F]; acceleration stage.

    MuJoCo's sign: a foot that stands presses down, z is negative.
    The logarithm keeps an impact of hundreds of newtons in the range of the other observations.
    """

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        force_EL = view.contact(self.sensor).force_EN3.flatten(start_dim=1)
        return torch.sign(force_EL) * torch.log1p(torch.abs(force_EL))
