"""Weighs and sums the reward terms."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import RewardTerm


class RewardManager:
    """Computes the weighted terms and their sums over the episode.

    Weights live on the device, so that a curriculum can change them inside a captured step. A term of weight 0 is not
    computed, unless a curriculum names it in `adapted`.
    """

    def __init__(
        self, terms: Mapping[str, RewardTerm], driver: EnvDriver, *, scale: float, adapted: frozenset[str]
    ) -> None:
        unknown = sorted(adapted - terms.keys())
        if unknown:
            raise ValueError(
                f"a curriculum adapts the unknown reward {unknown[0]!r}: {near(unknown[0], terms)}"
            )
        self._driver, self._view = driver, driver.view
        view = driver.view
        self._scale = scale
        self._terms = {name: term for name, term in terms.items() if term.weight != 0.0 or name in adapted}
        self.names = tuple(self._terms)
        self.weights_R = torch.tensor([term.weight for term in self._terms.values()], device=view.device)
        self.episode_sums_ER = view.buffers.get("rewards.episode_sums_ER", len(self.names))
        driver.readings.reward_weights.update(zip(self.names, self.weights_R.unbind(), strict=True))
        driver.readings.episode_rewards.update(zip(self.names, self.episode_sums_ER.unbind(-1), strict=True))
        self.step(torch.ones(view.num_envs, dtype=torch.bool, device=view.device))

    def step(self, finite_E: Bool[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the reward of the current state, float32 [E]; rows whose physics failed get 0."""
        values = []
        for name, term in self._terms.items():
            with self._driver.scope(f"rewards/{name}"):
                values.append(self._checked(name, term(self._view)))
        if not values:
            return torch.zeros(self._view.num_envs, device=self._view.device)
        weighted_ER = torch.stack(values, dim=-1) * (self.weights_R * self._scale)
        weighted_ER = torch.where(finite_E[:, None], weighted_ER, 0.0)
        self.episode_sums_ER.add_(weighted_ER)
        return weighted_ER.sum(-1)

    def _checked(self, name: str, value_E: Tensor) -> Tensor:
        if value_E.shape != (self._view.num_envs,):
            raise ValueError(
                f"reward term {name!r} returns shape {tuple(value_E.shape)}: expected ({self._view.num_envs},)"
            )
        return value_E
