"""This module has the policy that collects for off-policy learning: it adds noise, and acts at random at first."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Shaped
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor


class ExploringPolicy(TensorDictModuleBase):
    """Lets a policy act with noise on its actions, and before learning starts with random actions instead.

    Each env has its own scale of noise, drawn uniformly from a range and drawn anew at the end of an episode, so that
    one batch of envs explores both timidly and boldly (Seo et al., "FastTD3", arXiv 2505.22642). Draws come from
    torch's default generator; nothing here makes a host sync.

    Args:
        actor: reads observations and writes "action".
        low_L, high_L: bounds of the actions, [action_dim]; they stay where they are.
        num_envs: E.
        noise_min, noise_max: range of the standard deviation of the noise, in units of half the range of an action.
            Zeros add none, for policies that draw their actions themselves.
    """

    random: Tensor
    noise_scale_E1: Tensor

    def __init__(
        self,
        actor: TensorDictModuleBase,
        *,
        low_L: Float[Tensor, " L"],
        high_L: Float[Tensor, " L"],
        num_envs: int,
        noise_min: float = 0.0,
        noise_max: float = 0.0,
    ) -> None:
        super().__init__()
        self.actor = actor
        self.in_keys: Any = list(actor.in_keys)
        self.out_keys: Any = ["action"]
        self.noise_min, self.noise_max = noise_min, noise_max
        self._low_L, self._high_L = low_L, high_L
        self.register_buffer("random", torch.ones((), dtype=torch.bool, device=low_L.device))
        self.register_buffer("noise_scale_E1", self._draw_scales(num_envs))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action" [E, action_dim]."""
        acting = self.actor(tensordict.select(*self.in_keys))
        action = acting.get("action")
        if self.noise_max > 0.0:
            half_range = (self._high_L - self._low_L) / 2
            noise = torch.randn_like(action) * self.noise_scale_E1 * half_range
            action = torch.maximum(torch.minimum(action + noise, self._high_L), self._low_L)
        anything = self._low_L + torch.rand_like(action) * (self._high_L - self._low_L)
        return tensordict.set("action", torch.where(self.random, anything, action))

    @torch.no_grad()
    def end_episodes_(self, done_E: Bool[Tensor, " E"]) -> None:
        """Draw new scales of noise for the envs that `done_E` marks."""
        fresh_E1 = self._draw_scales(done_E.shape[0])
        self.noise_scale_E1.copy_(torch.where(done_E[:, None], fresh_E1, self.noise_scale_E1))

    def exploration_state(self) -> dict[str, Shaped[Tensor, "*?shape"]]:
        """Return what is this policy's own, without its actor: tensors that `load` may copy into."""
        return {"random": self.random, "noise_scale": self.noise_scale_E1}

    def _draw_scales(self, num_envs: int) -> Tensor:
        unit_E1 = torch.rand(num_envs, 1, device=self._low_L.device)
        return self.noise_min + (self.noise_max - self.noise_min) * unit_E1
