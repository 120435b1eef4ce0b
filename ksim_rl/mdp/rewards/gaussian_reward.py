"""Rewards of errors fall like a bell curve; this is their base."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.envs.term import RewardTerm


@dataclass(frozen=True, kw_only=True)
class GaussianReward(RewardTerm):
    """exp(-error^2 / std^2): 1 without an error.

    Attributes:
        std: in the unit of the error.
    """

    std: Positive

    def rate(self, squared_error_E: Float[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the reward of a squared error."""
        return torch.exp(squared_error_E / -(self.std**2))
