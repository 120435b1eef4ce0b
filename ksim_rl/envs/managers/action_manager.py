"""Splits the action among its terms and remembers it."""

import warnings
from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import ActionTerm
from ksim_rl.scene.state.buffers import ENV


class ActionManager:
    """Gives each action term its columns, in the order of the config.

    `bounds_L2` is the range of each column, (low, high), or None where a column has none.
    """

    def __init__(self, terms: Mapping[str, ActionTerm], driver: EnvDriver) -> None:
        self._driver = driver
        self._view = view = driver.view
        self.sizes: dict[str, int] = {}
        bounds: list[Tensor | None] = []
        self._parts: list[tuple[str, ActionTerm, slice]] = []
        start = 0
        # Columns are dealt out in the order of the config: this order is the layout of the policy's output.
        for name, term in terms.items():
            with self._driver.scope(f"actions/{name}", part=term):
                self.sizes[name] = size = term.size(view)
                # A bool is an int in Python, and would count as one column.
                if isinstance(size, bool) or not isinstance(size, int):
                    raise ValueError(
                        f"size() returns {size!r}: expected how many columns of the action it takes"
                    )
                if size < 1:
                    raise ValueError("it takes no number of the action: it selects nothing")
                part_K2 = term.bounds(view)
                if part_K2 is not None and part_K2.shape != (size, 2):
                    raise ValueError(
                        f"bounds() returns shape {tuple(part_K2.shape)}: expected ({size}, 2), (low, high) by column"
                    )
                bounds.append(part_K2)
            stop = start + self.sizes[name]
            self._parts.append((f"actions/{name}", term, slice(start, stop)))
            start = stop
        self.size = start
        # One unbounded column leaves the whole action spec unbounded.
        given = [
            part_K2 for part_K2 in bounds if part_K2 is not None and torch.isfinite(part_K2).all()
        ]
        if len(given) == len(terms) > 0:
            self.bounds_L2 = torch.cat(given)
        else:
            self.bounds_L2 = None
        # Pinned, and read as an array: reading the last copied value never waits for the device.
        pinned = torch.device(view.device).type == "cuda"
        self._accepts_any = torch.ones(1, dtype=torch.bool, pin_memory=pinned)
        self._arrived = self._accepts_any.numpy()
        self._has_warned = False
        buffers = driver.buffers
        readings = driver.readings
        # Buffers of the env, which resets clear: a new episode starts with action and last action of 0.
        self._action_EL = readings.action_EL = buffers.get("actions.action_EL", start, owner=ENV)
        self._last_action_EL = readings.last_action_EL = buffers.get(
            "actions.last_action_EL", start, owner=ENV
        )
        # Once with zeros, so that a wrong name or shape is an error now.
        self._run_terms(self._action_EL)

    def checked(self, action: Shaped[Tensor, "*shape"] | None) -> Float[Tensor, "E L"]:
        """Return an action without its gradient; a ValueError where it is missing, or has another shape or dtype."""
        expected = (self._view.num_envs, self.size)
        if action is None:
            raise ValueError(
                f"the tensordict has no 'action': expected float32 of shape {expected}"
            )
        if tuple(action.shape) != expected or action.dtype != torch.float32:
            raise ValueError(
                f"action has dtype {action.dtype} and shape {tuple(action.shape)}: expected torch.float32 and "
                f"{expected}"
            )
        # Physics has no gradient: a policy that is not run under `no_grad` has its own only.
        return action.detach()

    def apply(self, action_EL: Float[Tensor, "E L"]) -> Bool[Tensor, " E"]:
        """Write the controls of the action, and return which rows were finite; the others repeat their last action."""
        # Also false for NaN, and in fewer kernels than `torch.isfinite`.
        finite_E = action_EL.sum(-1).abs() < torch.inf
        # In place: observations, rewards and captured graphs read these addresses.
        self._last_action_EL.copy_(self._action_EL)
        self._action_EL.copy_(torch.where(finite_E[:, None], action_EL, self._last_action_EL))
        self._run_terms(self._action_EL)
        self._watch(finite_E)
        return finite_E

    def rehearse(self) -> None:
        """Run each term once more; the caller puts back what changes."""
        self._run_terms(self._action_EL)

    def _watch(self, finite_E: Tensor) -> None:
        """Say once that no row's action was finite; on a GPU a few steps late, and not from within a graph."""
        if self._has_warned or (finite_E.is_cuda and torch.cuda.is_current_stream_capturing()):
            return
        # Does not wait: the flag that is read below may be one of an earlier step.
        self._accepts_any.copy_(finite_E.any()[None], non_blocking=True)
        if not self._arrived[0]:
            self._has_warned = True
            warnings.warn(
                "no env's action is finite: all repeat their last one and end as non_finite (said once). A usual cause "
                "is a policy with NaN weights, or a distribution with the infinite bounds of an unbounded action spec",
                RuntimeWarning,
                stacklevel=2,
            )

    def _run_terms(self, action_EL: Float[Tensor, "E L"]) -> None:
        for scope, term, columns in self._parts:
            with self._driver.scope(scope, part=term):
                term(self._view, action_EL[:, columns])
