"""Keeps the commands: clocks, resampling, and the vectors that policy and rewards see."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from ksim_rl.checks import check_known
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.masked_reset import mask_from_env_ids
from ksim_rl.envs.term import CommandTerm
from ksim_rl.scene.state.buffers import ENV, Kept, only_in_rows


class CommandManager:
    """Holds one command vector per term, [E, K], in `values`, and one resampling clock per env and term.

    Clocks count down in seconds and run out at the env step that is nearest.
    """

    def __init__(self, terms: Mapping[str, CommandTerm], driver: EnvDriver) -> None:
        self._driver = driver
        self._view = view = driver.view
        self._terms = dict(terms)
        self.values = driver.readings.commands
        # Seconds left [E], only for terms that resample within an episode.
        self._clocks = {
            name: view.buffers.get(f"commands/{name}.time_left_E", owner=ENV)
            for name, term in terms.items()
            if term.resampling_time_range_s is not None
        }
        # The buffers that each term writes whenever its vector is computed; most write none.
        self._kept: dict[str, dict[str, Kept]] = {name: {} for name in terms}
        nobody_E = torch.zeros(view.num_envs, dtype=torch.bool, device=view.device)
        for name, term in terms.items():
            with self._driver.scope(f"commands/{name}", part=term, mask_E=nobody_E):
                # Draws for no row, so that the buffers that `__call__` reads exist.
                term.resample(view, nobody_E)
            value_EK = self._computed(name)
            with self._driver.scope(f"commands/{name}"):
                if term.ranges:
                    # Columns beyond `ranges` are the term's own.
                    columns = term.shared_ranges(view).unbind(-1)
                    driver.readings.command_ranges[name] = dict(
                        zip(term.ranges, columns, strict=False)
                    )
            # The number of columns K is known from the first vector.
            self.values[name] = view.buffers.get(
                f"commands/{name}.value_EK", value_EK.shape[1], owner=ENV
            )
            driver.non_finite.watch("command", self.values[name], (name,), value_EK.shape[1:])

    def time_left(self, name: str) -> Float[Tensor, " E"]:
        """Return the seconds until each env resamples, [E]; infinite for a command that only resets resample."""
        if name in self._clocks:
            return self._clocks[name]
        # No clock: this command lasts for the episode.
        return torch.full((self._view.num_envs,), torch.inf, device=self._view.device)

    def levels(self) -> dict[str, Float[Tensor, ""]]:
        """Return the present ends of the ranges, at `<command>/<field>_low` and `<command>/<field>_high`."""
        ends = {}
        for command, ranges in self._driver.readings.command_ranges.items():
            for field, pair_2 in ranges.items():
                low, high = pair_2.unbind()
                ends[f"{command}/{field}_low"] = low
                ends[f"{command}/{field}_high"] = high
        return ends

    def set(
        self,
        name: str,
        values: Shaped[Tensor, "*shape"] | Sequence[float],
        env_ids: Sequence[int] | Shaped[Tensor, "*rows"] | None = None,
    ) -> None:
        """Set a command that takes values from outside (`JoystickCommand`); call it between two steps.

        The next observation shows them. Values, [K] or a row for each env [E, K], are written in place, so that a
        captured step sees them too. A ValueError for an unknown name, a command that is drawn, values that do not fit,
        or envs that do not exist.
        """
        check_known("command", name, self._terms)
        view = self._view
        # Checked on the host: this is called between steps, not within them.
        if env_ids is None:
            rows = range(view.num_envs)
        else:
            rows = env_ids
        mask_E = mask_from_env_ids(rows, torch.Size([view.num_envs]), view.device)
        value_EK = torch.as_tensor(values, dtype=torch.float32, device=view.device)
        with self._driver.scope(f"commands/{name}"):
            self._terms[name].set(view, value_EK, mask_E)

    def resample(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw new targets for the rows of `mask_E` that reset."""
        for name, term in self._terms.items():
            self._draw(name, term, mask_E, "reset", self._view.reset_count_E)

    def refresh(self, mask_E: Bool[Tensor, " E"], *, is_step: bool = False) -> None:
        """Recompute the command vectors of the rows of `mask_E` from the current state and targets.

        Buffers of terms advance in these rows only; values that all envs share, only if this `is_step` of the env.
        """
        for name in self._terms:
            # A term that writes while it is read must not advance the rows that are not refreshed.
            kept = list(self._kept[name].values())
            with only_in_rows(mask_E, kept, is_step=is_step) if kept else nullcontext():
                value_EK = self._computed(name)
            held_EK = self.values[name]
            # In place, as the view and captured graphs hold this address.
            held_EK.copy_(torch.where(mask_E[:, None], value_EK, held_EK))
            self._driver.non_finite.watch("command", held_EK, (name,), (held_EK.shape[1],))
        # Quantities that follow from commands are stale now.
        self._view.command_cache.clear()

    def step(self, going_on_E: Bool[Tensor, " E"]) -> None:
        """Run the clocks of the rows that go on, resample where they ran out, and recompute these rows' vectors."""
        for name, term in self._terms.items():
            if name in self._clocks:
                clock_E = self._clocks[name]
                # Rows that are done are left out: the reset redraws them anyway, by the counter of resets.
                clock_E.sub_(self._view.step_dt)
                # Half a step, so that rounding of the subtractions cannot shift the moment by a step.
                due_E = (clock_E < 0.5 * self._view.step_dt) & going_on_E
                self._draw(name, term, due_E, "step", self._view.step_count)
        self.refresh(going_on_E, is_step=True)

    def rehearse(self) -> None:
        """Run each term once more; the caller puts back what changes."""
        nobody_E = torch.zeros(self._view.num_envs, dtype=torch.bool, device=self._view.device)
        self.resample(nobody_E)
        for name in self._terms:
            self._computed(name)

    def _computed(self, name: str) -> Tensor:
        """Return the vector of a term in the current state, and note the tensors that it writes on the way."""
        term = self._terms[name]
        with self._driver.scope(f"commands/{name}", part=term) as written:
            value_EK = term(self._view)
        self._kept[name].update(written)
        self._check(name, value_EK)
        return value_EK

    def _check(self, name: str, value_EK: object) -> None:
        """Refuse a value that has not one row per env, by the term's name."""
        expected = f"expected [{self._view.num_envs}, K], one row per env"
        if not isinstance(value_EK, Tensor):
            raise ValueError(f"command term {name!r} returns {type(value_EK).__name__}: {expected}")
        shape = tuple(value_EK.shape)
        if len(shape) != 2 or shape[0] != self._view.num_envs:
            raise ValueError(f"command term {name!r} returns shape {shape}: {expected}")
        if name in self.values and shape != tuple(self.values[name].shape):
            first = tuple(self.values[name].shape)
            raise ValueError(
                f"command term {name!r} returns shape {shape}, and first had {first}: expected the same in each step"
            )

    def _draw(
        self, name: str, term: CommandTerm, mask_E: Bool[Tensor, " E"], moment: str, counter: Tensor
    ) -> None:
        if term.resampling_time_range_s is not None:
            clock_E = self._clocks[name]
            with self._driver.scope(f"commands/{name}/clock/{moment}", counter):
                # Drawn for all rows and used in a few: sizes must not depend on data in a captured step.
                drawn_E = self._view.uniform(1, *term.resampling_time_range_s)[:, 0]
            clock_E.copy_(torch.where(mask_E, drawn_E, clock_E))
        with self._driver.scope(
            f"commands/{name}", counter, draws=moment, part=term, mask_E=mask_E
        ):
            term.resample(self._view, mask_E)
