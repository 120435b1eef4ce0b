"""Rewards for following a velocity command (vx, vy, wz) in the root's frame; velocity stage."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class TrackLinearVelocity(RewardTerm):
    """exp(-(|c_xy - v_xy|^2 + v_z^2) / std^2), `v` the root's linear velocity in its own frame, m/s, [E]."""

    command: str
    std: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("std", self.std, low=0.0, low_open=True)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        vel_E3 = view.root_lin_vel_b_EL
        error_E2 = view.command(self.command)[:, :2] - vel_E3[:, :2]
        return torch.exp(-(error_E2.square().sum(-1) + vel_E3[:, 2].square()) / self.std**2)


@dataclass(frozen=True, kw_only=True)
class TrackAngularVelocity(RewardTerm):
    """exp(-((c_z - w_z)^2 + |w_xy|^2) / std^2), `w` the root's angular velocity in its own frame, rad/s, [E]."""

    command: str
    std: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("std", self.std, low=0.0, low_open=True)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        vel_E3 = view.root_ang_vel_b_EL
        error_E = view.command(self.command)[:, 2] - vel_E3[:, 2]
        return torch.exp(-(error_E.square() + vel_E3[:, :2].square().sum(-1)) / self.std**2)
