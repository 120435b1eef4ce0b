"""Splits the action among its terms and remembers it."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import ActionTerm


class ActionManager:
    """Gives each action term its columns, in the order of the config."""

    def __init__(self, terms: Mapping[str, ActionTerm], driver: EnvDriver) -> None:
        self._driver, self._view = driver, driver.view
        view = driver.view
        self.sizes: dict[str, int] = {}
        self._parts: list[tuple[str, ActionTerm, slice]] = []
        start = 0
        for name, term in terms.items():
            with self._driver.scope(f"actions/{name}"):
                self.sizes[name] = term.size(view)
            stop = start + self.sizes[name]
            self._parts.append((f"actions/{name}", term, slice(start, stop)))
            start = stop
        self.size = start
        self._action_EL = driver.readings.action_EL = driver.buffers.get("actions.action_EL", start)
        self._last_action_EL = driver.readings.last_action_EL = driver.buffers.get(
            "actions.last_action_EL", start
        )
        self._run_terms(self._action_EL)

    def apply(self, action_EL: Float[Tensor, "E L"]) -> Bool[Tensor, " E"]:
        """Write the controls of `action_EL` [E, L]; rows with a non-finite entry repeat their last action.

        Returns:
            Which rows were finite, bool [E].
        """
        # Also false for NaN, and in fewer kernels than `torch.isfinite`.
        finite_E = action_EL.sum(-1).abs() < torch.inf
        self._last_action_EL.copy_(self._action_EL)
        self._action_EL.copy_(torch.where(finite_E[:, None], action_EL, self._last_action_EL))
        self._run_terms(self._action_EL)
        return finite_E

    def _run_terms(self, action_EL: Float[Tensor, "E L"]) -> None:
        for scope, term, columns in self._parts:
            with self._driver.scope(scope):
                term(self._view, action_EL[:, columns])
