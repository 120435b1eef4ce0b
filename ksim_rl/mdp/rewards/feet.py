"""These rewards rate contacts and how feet move; `active` is 1 while the commanded speed exceeds a threshold, else 0.

Poses and velocities are of the current state, contacts and forces of the last physics substep (acceleration stage).
"""

from dataclasses import dataclass
from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import index_constant
from ksim_rl.mdp.fields import (
    OfContacts,
    OfFeet,
    OfSensor,
    OfSites,
    RewardWhileCommanded,
    contact_force,
)


@dataclass(frozen=True, kw_only=True)
class ContactForceAbove(OfContacts, RewardTerm):
    """Sum over the sensor's elements of how far the net contact force exceeds a threshold, N."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # Only the excess counts: standing itself is free.
        return (contact_force(view, self.sensor) - self.threshold).clamp(min=0.0).sum(-1)


@dataclass(frozen=True, kw_only=True)
class UndesiredContacts(OfContacts, RewardTerm):
    """Number of the sensor's elements whose net contact force exceeds a threshold."""

    threshold: NonNegative = 1.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (contact_force(view, self.sensor) > self.threshold).to(torch.float32).sum(-1)


@dataclass(frozen=True, kw_only=True)
class SelfCollision(OfContacts, RewardTerm):
    """Number of physics substeps of the env step in which a self-contact force exceeds a threshold.

    The sensor is one of the robot against itself: `ContactSensor(subtrees=(root,), against=root,
    against_kind="subtree", reduce="strongest", every_substep=True)`. Without `every_substep` only the last is seen.
    With a sensor of parts against the ground it counts their collisions alike.
    """

    threshold: NonNegative = 10.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # [E, S, N]: S substeps of the env step, N elements.
        force_ESN = torch.linalg.vector_norm(view.contact(self.sensor).force_history_ESN3, dim=-1)
        # The strongest element in each substep, then how many substeps were over it.
        return (force_ESN.amax(-1) > self.threshold).to(torch.float32).sum(-1)


@dataclass(frozen=True, kw_only=True)
class FootClearance(OfSites, RewardWhileCommanded):
    """active * sum_f |height_f - target_height| * |v_xy,f|, m^2/s, [E]: above the ground, and in the world's axes."""

    target_height: float

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        feet = view.sites(self.sites)
        # Weighted by the speed: only feet that move must be high, so that standing costs nothing.
        miss_EF = (feet.height_EN - self.target_height).abs()
        speed_EF = torch.linalg.vector_norm(feet.lin_vel_EN3[..., :2], dim=-1)
        return self.while_commanded(view, (miss_EF * speed_EF).sum(-1))


@dataclass(frozen=True, kw_only=True)
class OfSwing(OfFeet, RewardWhileCommanded):
    """A reward of how high feet swing, which is known in the step of touch-down."""

    target_height: Positive

    def peak(self, view: EnvView) -> Float[Tensor, "E F"]:
        """Return the greatest height of each foot in its present swing, or the one that ends in this step, m."""
        contact = self.contact(view)
        height_EF = view.sites(self.sites).height_EN
        held_EF = view.buffer("peak_EF", height_EF.shape[-1])
        # Grows in the air only: at touch-down it still holds the peak of the swing.
        peak_EF = torch.where(contact.found_EN > 0, held_EF, torch.maximum(held_EF, height_EF))
        # Starts again with the next swing.
        held_EF.copy_(torch.where(contact.first_contact_EN > 0, 0.0, peak_EF))
        return peak_EF


@dataclass(frozen=True, kw_only=True)
class FootSwingHeight(OfSwing):
    """active * sum_f landed_f * (peak_f / target_height - 1)^2, [E]; `peak` is the greatest height of the swing, m."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        miss_EF = (self.peak(view) / self.target_height - 1.0).square()
        # Paid once per swing, in the step of touch-down.
        return self.while_commanded(view, (miss_EF * self.contact(view).first_contact_EN).sum(-1))


@dataclass(frozen=True, kw_only=True)
class FootSwingPeak(OfSwing):
    """active * max_f landed_f * min(peak_f, target_height), m, [E]: earned at touch-down by the highest swing."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        earned_EF = self.peak(view).clamp(max=self.target_height)
        return self.while_commanded(
            view, (earned_EF * self.contact(view).first_contact_EN).amax(-1)
        )


@dataclass(frozen=True, kw_only=True)
class FeetTooClose(OfSites, RewardTerm):
    """1 while any two of the sites are less than `min_distance` (m) apart, else 0, [E]; position stage."""

    min_distance: Positive

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        pos_EF3 = view.sites(self.sites).pos_EN3
        pairs = list(combinations(range(pos_EF3.shape[1]), 2))
        if not pairs:
            raise ValueError(f"sites={self.sites!r} match one site: give at least two")
        first, second = zip(*pairs, strict=True)
        gap_EP3 = (
            pos_EF3[:, index_constant(first, view.device)]
            - pos_EF3[:, index_constant(second, view.device)]
        )
        near_EP = torch.linalg.vector_norm(gap_EP3, dim=-1) < self.min_distance
        return near_EP.any(-1).to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class FootSlip(OfFeet, RewardWhileCommanded):
    """active * sum_f contact_f * |v_xy,f|^2, (m/s)^2; velocities of the sites, world frame, at that moment."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        speed2_EF = view.sites(self.sites).lin_vel_of_contacts_EN3[..., :2].square().sum(-1)
        return self.while_commanded(view, (speed2_EF * self.contact(view).found_EN).sum(-1))


@dataclass(frozen=True, kw_only=True)
class SoftLanding(OfSensor, RewardWhileCommanded):
    """active * sum_f landed_f * |force_f|, N, [E]; the net contact force at the end of the step of touch-down."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        landed_EF = view.contact(self.sensor).first_contact_EN
        return self.while_commanded(view, (contact_force(view, self.sensor) * landed_EF).sum(-1))


@dataclass(frozen=True, kw_only=True)
class FeetAirTime(OfSensor, RewardWhileCommanded):
    """active * number of feet whose present flight has lasted between two thresholds (s), [E]."""

    threshold_min: float
    threshold_max: float

    def _check_fields(self) -> None:
        super()._check_fields()
        check_in_range("threshold_max", self.threshold_max, low=self.threshold_min)

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        air_time_EF = view.contact(self.sensor).air_time_EN
        # Neither short hops nor long flights are rewarded.
        inside_EF = (air_time_EF > self.threshold_min) & (air_time_EF < self.threshold_max)
        return self.while_commanded(view, inside_EF.to(torch.float32).sum(-1))


@dataclass(frozen=True, kw_only=True)
class GaitPhase(OfSensor, RewardWhileCommanded):
    """Fraction of feet that swing where the sine of `gait`, a `SinusoidalGaitCommand`, is positive, else stand; [E]."""

    gait: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        touches_EF = view.contact(self.sensor).found_EN > 0
        phase_EL = view.command(self.gait)
        feet = touches_EF.shape[-1]
        # Sines come first, cosines second, one of each per foot.
        if phase_EL.shape[-1] != 2 * feet:
            raise ValueError(
                f"gait={self.gait!r} has {phase_EL.shape[-1] // 2} feet, sensor={self.sensor!r} has {feet}: give each "
                "foot one offset"
            )
        # A foot matches where it touches exactly when its sine says stance.
        matches_EF = touches_EF != (phase_EL[:, :feet] > 0)
        return self.while_commanded(view, matches_EF.to(torch.float32).mean(-1))
