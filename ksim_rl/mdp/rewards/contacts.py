"""These rewards rate contacts by their forces (acceleration stage); weights are usually negative."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfContacts
from ksim_rl.mdp.quantities import contact_force


@dataclass(frozen=True, kw_only=True)
class ContactForceAbove(OfContacts, RewardTerm):
    """Sum over the sensor's elements of how far the net contact force exceeds a threshold, N."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
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
    against_kind="subtree", reduce="strongest", every_substep=True)`. Without `every_substep` only the last substep is
    seen.
    """

    threshold: NonNegative = 10.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        force_ESN = torch.linalg.vector_norm(view.contact(self.sensor).force_history_ESN3, dim=-1)
        return (force_ESN.amax(-1) > self.threshold).to(torch.float32).sum(-1)
