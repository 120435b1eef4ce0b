"""Rewards for contacts and their forces, [E]; weights are usually negative. All are of the acceleration stage."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class ContactForceAbove(RewardTerm):
    """Sum over the sensor's elements of how far the net contact force exceeds a threshold, N, [E].

    Attributes:
        sensor: a contact sensor of `scene.sensors`.
        threshold: N.
    """

    sensor: str
    threshold: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("threshold", self.threshold, low=0.0)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        force_EN = torch.linalg.vector_norm(view.contact(self.sensor).force_EN3, dim=-1)
        return (force_EN - self.threshold).clamp(min=0.0).sum(-1)


@dataclass(frozen=True, kw_only=True)
class UndesiredContacts(RewardTerm):
    """Number of the sensor's elements whose net contact force exceeds a threshold, [E].

    Attributes:
        sensor: a contact sensor of `scene.sensors`.
        threshold: N.
    """

    sensor: str
    threshold: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("threshold", self.threshold, low=0.0)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        force_EN = torch.linalg.vector_norm(view.contact(self.sensor).force_EN3, dim=-1)
        return (force_EN > self.threshold).to(torch.float32).sum(-1)


@dataclass(frozen=True, kw_only=True)
class SelfCollision(RewardTerm):
    """Number of physics substeps of the env step in which a self-contact force exceeds a threshold, [E].

    Attributes:
        sensor: a contact sensor of `scene.sensors`, of the robot against itself: `ContactSensor(subtrees=(root,),
            against=root, against_kind="subtree", reduce="strongest", every_substep=True)`. Without `every_substep` only
            the last substep is seen.
        threshold: N.
    """

    sensor: str
    threshold: float = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("threshold", self.threshold, low=0.0)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        force_ESN = torch.linalg.vector_norm(view.contact(self.sensor).force_history_ESN3, dim=-1)
        return (force_ESN.amax(-1) > self.threshold).to(torch.float32).sum(-1)
