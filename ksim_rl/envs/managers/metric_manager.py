"""Reduces metrics over the episode."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import MetricTerm


class MetricManager:
    """Accumulates each metric over the running episodes as its term asks: mean, last, max or sum.

    Which of these occur is known at construction, and the others cost nothing in a step.
    """

    def __init__(self, terms: Mapping[str, MetricTerm], driver: EnvDriver) -> None:
        self._driver, self._view = driver, driver.view
        view = driver.view
        self._terms = dict(terms)
        self.names = tuple(terms)
        self._held_EM = view.buffers.get("metrics.held_EM", len(self.names))
        reductions = [term.reduce for term in terms.values()]
        self._occurring = frozenset(reductions)
        self._is_mean_M, self._is_last_M, self._is_max_M = (
            torch.tensor([given == kind for given in reductions], dtype=torch.bool, device=view.device)
            for kind in ("mean", "last", "max")
        )
        self.step(torch.ones(view.num_envs, dtype=torch.bool, device=view.device))

    def step(self, finite_E: Bool[Tensor, " E"]) -> None:
        """Take in the values of the current state; rows whose physics failed add nothing."""
        values = []
        for name, term in self._terms.items():
            with self._driver.scope(f"metrics/{name}"):
                value_E = term(self._view)
            if value_E.shape != finite_E.shape:
                raise ValueError(
                    f"metric term {name!r} returns shape {tuple(value_E.shape)}: expected {tuple(finite_E.shape)}"
                )
            values.append(value_E)
        if not values:
            return
        value_EM = torch.where(finite_E[:, None], torch.stack(values, dim=-1), 0.0)
        held_EM = self._held_EM
        next_EM = held_EM + value_EM
        if "last" in self._occurring:
            next_EM = torch.where(self._is_last_M, value_EM, next_EM)
        if "max" in self._occurring:
            is_first_E1 = self._view.episode_step_E[:, None] <= 1
            peak_EM = torch.where(is_first_E1, value_EM, torch.maximum(held_EM, value_EM))
            next_EM = torch.where(self._is_max_M, peak_EM, next_EM)
        held_EM.copy_(next_EM)

    @property
    def reduced_EM(self) -> Float[Tensor, "E M"]:
        """The reduced values of the episodes so far, float32 [E, M]."""
        if "mean" not in self._occurring:
            return self._held_EM
        mean_EM = self._held_EM / self._view.episode_step_E[:, None].clamp(min=1)
        return torch.where(self._is_mean_M, mean_EM, self._held_EM)
