"""Runs events: at startup, for rows that reset, by per-env clocks, and at every step."""

import warnings
from collections.abc import Iterable, Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import EventTerm
from ksim_rl.scene.state.buffers import ENV


class EventManager:
    """Runs each event in its mode, then recomputes the model constants that follow from the fields that it wrote.

    Interval clocks count down in seconds, one per env and event, and start again when a row resets. They run out at the
    nearest env step, so that an interval of n steps ends at the n-th, whatever the subtractions round to.
    """

    def __init__(self, terms: Mapping[str, EventTerm], driver: EnvDriver) -> None:
        self._driver = driver
        self.terms = dict(terms)
        self._view = view = driver.view
        self._by_mode: dict[str, list[tuple[str, EventTerm]]] = {}
        for name, term in terms.items():
            self._by_mode.setdefault(term.mode, []).append((f"events/{name}", term))
        # By mode the model fields that its events write, each once: derived constants follow from them.
        self._fields = {
            mode: tuple(
                dict.fromkeys(field for _, term in parts for field in term.per_world_fields)
            )
            for mode, parts in self._by_mode.items()
        }
        clocked = self._by_mode.get("interval", [])
        self._clocks = {
            scope: view.buffers.get(f"{scope}.time_left_E", owner=ENV) for scope, _ in clocked
        }
        # Names that match nothing are errors now, and all buffers exist before the first step.
        # Events that may read commands wait for these: see `rehearse_starts`.
        self._rehearse(name for name, term in terms.items() if term.mode != "start")
        for name, term in terms.items():
            term.check_beside(view, terms)
            for line in term.without_effect(view):
                warnings.warn(f"events.{name}: {line}", UserWarning, stacklevel=2)

    def rehearse(self) -> None:
        """Run each event for no row, which changes nothing."""
        self._rehearse(self.terms)

    def rehearse_starts(self) -> None:
        """Run the events that may read commands for no row, once there are commands."""
        self._rehearse(name for name, term in self.terms.items() if term.mode == "start")
        # Nothing has changed.
        self._driver.refreshed()

    def _rehearse(self, names: Iterable[str]) -> None:
        nobody_E = torch.zeros(self._view.num_envs, dtype=torch.bool, device=self._view.device)
        for name in names:
            self._run(f"events/{name}", self.terms[name], nobody_E)

    def startup(self) -> None:
        """Run the startup events for all rows; their numbers depend on the seed only."""
        everybody_E = torch.ones(self._view.num_envs, dtype=torch.bool, device=self._view.device)
        for scope, term in self._by_mode.get("startup", []):
            self._run(scope, term, everybody_E, self._driver.startup_counter)
        # Once after all events, since several may write the same field.
        self._view.world.set_const(self._fields.get("startup", ()))

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Run the reset events for the rows of `mask_E`, and restart their interval clocks."""
        view = self._view
        for scope, term in self._by_mode.get("reset", []):
            self._run(scope, term, mask_E, view.reset_count_E)
        # Only in the rows that reset, as other worlds keep their constants.
        view.world.set_const(self._fields.get("reset", ()), mask_E)
        for scope, term in self._by_mode.get("interval", []):
            with self._driver.scope(f"{scope}/clock", view.reset_count_E):
                self._restart(scope, term, mask_E)

    def start(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Run the events that begin the episodes of the rows of `mask_E`, and refresh what derives from the state."""
        view = self._view
        if "start" not in self._by_mode:
            return
        for scope, term in self._by_mode["start"]:
            self._run(scope, term, mask_E, view.reset_count_E)
        view.world.set_const(self._fields["start"], mask_E)
        view.world.refresh(mask_E)
        self._driver.refreshed()

    def step(self) -> None:
        """Run the interval events whose clocks have run out, and the step events."""
        view = self._view
        written: list[Tensor] = []
        for scope, term in self._by_mode.get("interval", []):
            # Seconds left [E], counted down in place.
            clock_E = self._clocks[scope]
            clock_E.sub_(view.step_dt)
            # Half a step is the tolerance for rounding of the subtractions.
            due_E = clock_E < 0.5 * view.step_dt
            # The clock is set before the event runs, from a random stream of its own.
            with self._driver.scope(f"{scope}/interval"):
                self._restart(scope, term, due_E)
            self._run(scope, term, due_E)
            if term.per_world_fields:
                written.append(due_E)
        # The rows in which any event was due.
        if written:
            view.world.set_const(self._fields["interval"], torch.stack(written).any(0))
        if "step" in self._by_mode:
            everybody_E = torch.ones(view.num_envs, dtype=torch.bool, device=view.device)
            for scope, term in self._by_mode["step"]:
                self._run(scope, term, everybody_E)
            view.world.set_const(self._fields["step"], everybody_E)

    def _run(
        self, scope: str, term: EventTerm, mask_E: Bool[Tensor, " E"], counter: Tensor | None = None
    ) -> None:
        with self._driver.scope(scope, counter, part=term, mask_E=mask_E):
            term(self._view, mask_E)

    def _restart(self, scope: str, term: EventTerm, mask_E: Bool[Tensor, " E"]) -> None:
        assert term.interval_range_s is not None
        low, high = term.interval_range_s
        clock_E = self._clocks[scope]
        drawn_E = self._view.uniform(1, low, high)[:, 0]
        clock_E.copy_(torch.where(mask_E, drawn_E, clock_E))
