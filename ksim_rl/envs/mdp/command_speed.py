"""How fast a velocity command asks to move: what pose and foot rewards switch on."""

import torch
from torch import Tensor

from ksim_rl.envs.view import EnvView


def commanded_speed(view: EnvView, command: str) -> Tensor:
    """Return |c_xy| + |c_z| of the command (vx, vy, wz), m/s and rad/s added as numbers, [E]."""
    command_EK = view.command(command)
    return torch.linalg.vector_norm(command_EK[:, :2], dim=-1) + command_EK[:, 2].abs()


def is_commanded(view: EnvView, command: str, threshold: float) -> Tensor:
    """Return 1 where the commanded speed exceeds the threshold, else 0, float32 [E]."""
    return (commanded_speed(view, command) > threshold).to(torch.float32)
