"""Rewards of poses and feet read here how fast a velocity command asks to move; it is computed once per command."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class RewardWhileCommanded(RewardTerm):
    """A reward that counts only while a velocity command asks to move.

    Attributes:
        command, command_threshold: the term is 0 unless the commanded speed exceeds the threshold.
    """

    command: str
    command_threshold: NonNegative

    def while_commanded(self, view: EnvView, value_E: Float[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the value where the command asks to move, else 0."""
        return value_E * is_commanded(view, self.command, self.command_threshold)


def commanded_speed(view: EnvView, command: str) -> Float[Tensor, " E"]:
    """Return |c_xy| + |c_z| of the command (vx, vy, wz), m/s and rad/s added as numbers."""
    key = f"speed of {command}"
    speed_E = view.command_cache.get(key)
    if speed_E is None:
        command_EK = view.command(command)
        speed_E = torch.linalg.vector_norm(command_EK[:, :2], dim=-1) + command_EK[:, 2].abs()
        view.command_cache[key] = speed_E
    return speed_E


def is_commanded(view: EnvView, command: str, threshold: float) -> Float[Tensor, " E"]:
    """Return 1 where the commanded speed exceeds the threshold, else 0."""
    key = f"speed of {command} > {threshold}"
    moves_E = view.command_cache.get(key)
    if moves_E is None:
        moves_E = (commanded_speed(view, command) > threshold).to(torch.float32)
        view.command_cache[key] = moves_E
    return moves_E
