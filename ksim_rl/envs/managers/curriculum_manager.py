"""Runs the curricula for the rows that reset, and reports their levels."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import CurriculumTerm


class CurriculumManager:
    """Keeps the latest level of each curriculum on the device.

    Raises:
        ValueError: if two curricula drive `view.level`, or one does not return a single level.
    """

    def __init__(self, terms: Mapping[str, CurriculumTerm], driver: EnvDriver) -> None:
        self._driver, self._view = driver, driver.view
        view = driver.view
        self._terms = dict(terms)
        self.names = tuple(terms)
        drivers = {name: term.first_level for name, term in terms.items() if term.first_level is not None}
        if len(drivers) > 1:
            raise ValueError(f"curriculum: {' and '.join(drivers)} all drive the one level: keep one of them")
        for level in drivers.values():
            driver.readings.level.fill_(level)
        self.levels_C = torch.zeros(len(self.names), device=view.device)
        self.reset(torch.zeros(view.num_envs, dtype=torch.bool, device=view.device))

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Adapt to the episodes that just ended in the rows of `mask_E`."""
        for index, (name, term) in enumerate(self._terms.items()):
            with self._driver.scope(f"curriculum/{name}", self._view.reset_count_E):
                level = term(self._view, mask_E)
            if level.shape != ():
                raise ValueError(
                    f"curriculum term {name!r} returns shape {tuple(level.shape)}: expected (), one level for all envs"
                )
            self.levels_C[index].copy_(level)
