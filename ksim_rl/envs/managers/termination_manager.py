"""This module decides which episodes end, and whether by a failure or by time."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import TerminationTerm


class TerminationManager:
    """Combines the termination terms with the guard against non-finite physics."""

    def __init__(
        self, terms: Mapping[str, TerminationTerm], driver: EnvDriver, *, is_finite_horizon: bool
    ) -> None:
        self._driver, self._view = driver, driver.view
        view = driver.view
        self._terms = dict(terms)
        self._is_finite_horizon = is_finite_horizon
        self.names = (*terms, "non_finite")
        self.flags_EK = torch.zeros(view.num_envs, len(self.names), dtype=torch.bool, device=view.device)
        driver.readings.terminations.update(zip(self.names, self.flags_EK.unbind(-1), strict=True))
        time_out = [term.time_out for term in terms.values()] + [False]
        self._time_out_K = torch.tensor(time_out, device=view.device)
        self._failure_K = ~self._time_out_K
        self.step(torch.ones(view.num_envs, dtype=torch.bool, device=view.device))

    def step(self, finite_E: Bool[Tensor, " E"]) -> tuple[Bool[Tensor, " E"], Bool[Tensor, " E"]]:
        """Return `terminated` and `truncated` of the current state, bool [E] each.

        Rows whose physics failed are terminated. A row may be both; `terminated` is what ends the return.
        """
        flags = []
        for name, term in self._terms.items():
            with self._driver.scope(f"terminations/{name}"):
                flag_E = term(self._view)
            if flag_E.shape != finite_E.shape or flag_E.dtype != torch.bool:
                raise ValueError(
                    f"termination term {name!r} returns {flag_E.dtype} {tuple(flag_E.shape)}: expected torch.bool "
                    f"{tuple(finite_E.shape)}"
                )
            flags.append(flag_E)
        self.flags_EK.copy_(torch.stack((*flags, ~finite_E), dim=-1))
        timed_out_E = (self.flags_EK & self._time_out_K).any(-1)
        failed_E = (self.flags_EK & self._failure_K).any(-1)
        self._driver.readings.terminated_E.copy_(failed_E)
        self._driver.readings.truncated_E.copy_(timed_out_E)
        if self._is_finite_horizon:
            return failed_E | timed_out_E, torch.zeros_like(timed_out_E)
        return failed_E, timed_out_E
