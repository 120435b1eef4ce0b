"""Keeps the commands: clocks, resampling, and the vectors that policy and rewards see."""

from collections.abc import Mapping

import torch
from torch import Tensor

from ksim_rl.envs.term import CommandTerm
from ksim_rl.envs.view import EnvView


class CommandManager:
    """Holds one command vector per term, [E, K], and one resampling clock per env and term.

    Clocks count down in seconds and run out at the env step that is nearest.
    """

    def __init__(self, terms: Mapping[str, CommandTerm], view: EnvView) -> None:
        self._view = view
        self._terms = dict(terms)
        self._clocks = {name: view.memories.get(f"commands/{name}.time_left_E") for name in terms}
        nobody_E = torch.zeros(view.num_envs, dtype=torch.bool, device=view.device)
        for name, term in terms.items():
            with view.scope(f"commands/{name}"):
                term.resample(view, nobody_E)
                value_EK = term(view)
            if value_EK.ndim != 2 or value_EK.shape[0] != view.num_envs:
                raise ValueError(
                    f"command term {name!r} returns shape {tuple(value_EK.shape)}: expected [{view.num_envs}, K], one "
                    "row per env"
                )
            view.commands[name] = view.memories.get(f"commands/{name}.value_EK", value_EK.shape[1])

    @property
    def values(self) -> dict[str, Tensor]:
        """The current commands by name, [E, K]."""
        return self._view.commands

    def time_left(self, name: str) -> Tensor:
        """Return the seconds until each env resamples, [E]."""
        return self._clocks[name]

    def resample(self, mask_E: Tensor) -> None:
        """Draw new targets for the rows of `mask_E` that reset."""
        for name, term in self._terms.items():
            self._draw(name, term, mask_E, "reset", self._view.reset_count_E)

    def refresh(self, mask_E: Tensor) -> None:
        """Recompute the command vectors of the rows of `mask_E` from the current state and targets."""
        for name, term in self._terms.items():
            with self._view.scope(f"commands/{name}"):
                value_EK = term(self._view)
            held_EK = self._view.commands[name]
            held_EK.copy_(torch.where(mask_E[:, None], value_EK, held_EK))

    def step(self, going_on_E: Tensor) -> None:
        """Run the clocks of the rows that go on, resample where they ran out, and recompute these rows' vectors."""
        for name, term in self._terms.items():
            clock_E = self._clocks[name]
            clock_E.sub_(self._view.step_dt)
            self._draw(
                name, term, (clock_E < 0.5 * self._view.step_dt) & going_on_E, "step", self._view.step_count
            )
        self.refresh(going_on_E)

    def _draw(self, name: str, term: CommandTerm, mask_E: Tensor, moment: str, counter: Tensor) -> None:
        low, high = term.resampling_time_range_s
        clock_E = self._clocks[name]
        with self._view.scope(f"commands/{name}/clock/{moment}", counter):
            clock_E.copy_(torch.where(mask_E, self._view.uniform(1, low, high)[:, 0], clock_E))
        with self._view.scope(f"commands/{name}", counter, draws=moment):
            term.resample(self._view, mask_E)
