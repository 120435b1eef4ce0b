"""Rewards of errors fall like a bell curve; this is their base."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import RewardTerm


@dataclass(frozen=True, kw_only=True)
class GaussianReward(RewardTerm):
    """exp(-error^2 / std^2): 1 without an error.

    Attributes:
        std: in the unit of the error.
    """

    std: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("std", self.std, low=0.0, low_open=True)

    def rate(self, squared_error_E: Float[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the reward of a squared error."""
        return torch.exp(squared_error_E / -(self.std**2))
