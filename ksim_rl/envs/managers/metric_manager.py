"""Reduces metrics over the episode."""

from collections.abc import Mapping

import torch
from torch import Tensor

from ksim_rl.envs.term import METRIC_REDUCTIONS, MetricTerm
from ksim_rl.envs.view import EnvView


class MetricManager:
    """Accumulates each metric over the running episodes as its term asks: mean, last, max or sum."""

    def __init__(self, terms: Mapping[str, MetricTerm], view: EnvView) -> None:
        self._view = view
        self._terms = dict(terms)
        self.names = tuple(terms)
        count = len(self.names)
        self._sum_EM = view.memories.get("metrics.sum_EM", count)
        self._max_EM = view.memories.get("metrics.max_EM", count)
        self._last_EM = view.memories.get("metrics.last_EM", count)
        reductions = torch.tensor(
            [METRIC_REDUCTIONS.index(term.reduce) for term in terms.values()], device=view.device
        ).long()
        self._is_mean_M, self._is_last_M, self._is_max_M = (reductions == i for i in range(3))
        self.step(torch.ones(view.num_envs, dtype=torch.bool, device=view.device))

    def step(self, finite_E: Tensor) -> None:
        """Take in the values of the current state; rows whose physics failed add nothing."""
        values = []
        for name, term in self._terms.items():
            with self._view.scope(f"metrics/{name}"):
                value_E = term(self._view)
            if value_E.shape != finite_E.shape:
                raise ValueError(
                    f"metric term {name!r} returns shape {tuple(value_E.shape)}: expected {tuple(finite_E.shape)}"
                )
            values.append(value_E)
        if not values:
            return
        value_EM = torch.where(finite_E[:, None], torch.stack(values, dim=-1), 0.0)
        first_E1 = self._view.episode_step_E[:, None] <= 1
        self._sum_EM.add_(value_EM)
        self._max_EM.copy_(torch.where(first_E1, value_EM, torch.maximum(self._max_EM, value_EM)))
        self._last_EM.copy_(value_EM)

    @property
    def reduced_EM(self) -> Tensor:
        """The reduced values of the episodes so far, float32 [E, M]."""
        length_E1 = self._view.episode_step_E[:, None].clamp(min=1)
        mean_or_sum_EM = torch.where(self._is_mean_M, self._sum_EM / length_E1, self._sum_EM)
        last_or_max_EM = torch.where(self._is_last_M, self._last_EM, self._max_EM)
        return torch.where(self._is_last_M | self._is_max_M, last_or_max_EM, mean_or_sum_EM)
