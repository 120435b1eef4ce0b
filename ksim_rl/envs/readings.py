"""This module holds what sensors and managers give the terms of an env to read."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.scene.sensors import SensorTracker
from ksim_rl.scene.state.simulation import Simulation


class Readings:
    """What an `EnvView` shows beyond the worlds; managers fill it while the env is constructed, then write in place.

    The attributes are those of `EnvView`.
    """

    def __init__(self, simulation: Simulation) -> None:
        num_envs, device = simulation.num_envs, simulation.device
        self.sensors: dict[str, SensorTracker] = {}
        self.commands: dict[str, Float[Tensor, "E ?K"]] = {}
        self.command_ranges: dict[str, dict[str, Float[Tensor, " 2"]]] = {}
        self.reward_weights: dict[str, Float[Tensor, ""]] = {}
        self.episode_rewards: dict[str, Float[Tensor, " E"]] = {}
        self.terminations: dict[str, Bool[Tensor, " E"]] = {}
        self.terminated_E = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.truncated_E = torch.zeros_like(self.terminated_E)
        self.action_EL = torch.zeros(num_envs, 0, device=device)
        self.last_action_EL = torch.zeros_like(self.action_EL)
        self.level = simulation.shared_values.get("curriculum.level", 1.0)
        self.command_cache = simulation.new_cache()
