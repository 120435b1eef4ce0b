"""Reads each observation term once, clean."""

from collections.abc import Mapping

import torch
from torch import Tensor

from ksim_rl.envs.transforms.group_cfg import ObservationGroupCfg
from ksim_rl.envs.view import EnvView


class ObservationManager:
    """Computes the union of the groups' terms; what groups add to them is done by transforms."""

    def __init__(self, groups: Mapping[str, ObservationGroupCfg], view: EnvView) -> None:
        self._view = view
        self.terms = {name: cfg.term for group in groups.values() for name, cfg in group.terms.items()}
        for name, reading_EL in self.read().items():
            has_rows = reading_EL.ndim == 2 and reading_EL.shape[0] == view.num_envs
            if not has_rows or reading_EL.dtype != torch.float32:
                raise ValueError(
                    f"observation term {name!r} returns {reading_EL.dtype} {tuple(reading_EL.shape)}: expected "
                    f"torch.float32 [{view.num_envs}, L], one row per env"
                )

    def read(self) -> dict[str, Tensor]:
        """Return the readings of the current state by term, float32 [E, L], none of them aliasing the state."""
        readings = {}
        for name, term in self.terms.items():
            with self._view.scope(f"observations/{name}"):
                readings[name] = self._view.detached(term(self._view))
        return readings
