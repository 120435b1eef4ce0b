"""The managers of a step's outcomes: rewards, terminations, metrics and levels, and their sums over episodes."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checks import check_known, near
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import CurriculumTerm, Fields, MetricTerm, RewardTerm, TerminationTerm
from ksim_rl.scene.state.buffers import ENV


class _OutcomeManager:
    """Calls terms that return one value per env; each runs in its scope, and its value is checked."""

    kind: ClassVar[str]

    def __init__(
        self,
        terms: Mapping[str, Any],
        driver: EnvDriver,
        curriculum: Mapping[str, CurriculumTerm] | None = None,
    ) -> None:
        self._driver = driver
        self._view = driver.view
        self._terms = dict(terms)
        self.names = tuple(terms)
        # The terms of later stages, by the name of the term that they take the place of.
        self._later: dict[str, list[Any]] = {}
        for term in (curriculum or {}).values():
            for scope, stages in term.adapted_fields.items():
                kind, _, name = scope.partition("/")
                if kind == f"{self.kind}s":
                    self._later[name] = _staged(self.kind, name, self._terms, stages)
                    # Without an owner, as curricula write it.
                    driver.readings.stages[scope] = driver.shared_values.get(f"{scope}.stage", 0.0)

    def _everybody_E(self) -> Tensor:
        return torch.ones(self._view.num_envs, dtype=torch.bool, device=self._view.device)

    def _values(self, dtype: torch.dtype | None = None) -> list[Tensor]:
        """Return each term's value of the current state, [E] each, in any real dtype unless one is asked for."""
        return [self._value(name, term, dtype) for name, term in self._terms.items()]

    def _value(self, name: str, term: Any, dtype: torch.dtype | None) -> Tensor:
        """Return the value of a term, of the stage that holds."""
        scope = f"{self.kind}s/{name}"
        value_E = self._called(name, term, scope, dtype)
        # All stages are computed, since a captured step cannot branch; each has buffers of its own.
        for number, later in enumerate(self._later.get(name, ()), start=1):
            other_E = self._called(name, later, f"{scope}/stage {number}", dtype)
            value_E = torch.where(self._driver.readings.stages[scope] >= number, other_E, value_E)
        return value_E

    def _called(self, name: str, term: Any, scope: str, dtype: torch.dtype | None) -> Tensor:
        """Return the value of a term that runs in a scope, checked."""
        shape = (self._view.num_envs,)
        device = torch.device(self._view.device)
        with self._driver.scope(scope, part=term):
            value_E = term(self._view)
        if not isinstance(value_E, Tensor):
            raise ValueError(
                f"{self.kind} term {name!r} returns {type(value_E).__name__}: expected a tensor {shape}, one value "
                "per env"
            )
        if dtype is None:
            fits = not value_E.is_complex()
        else:
            fits = value_E.dtype == dtype
        if value_E.shape != shape or not fits:
            raise ValueError(
                f"{self.kind} term {name!r} returns {value_E.dtype} {tuple(value_E.shape)}: expected "
                f"{dtype or 'any real dtype'} {shape}, one value per env"
            )
        # A tensor of the host would be copied over in each step, which waits for the device.
        if value_E.device.type != device.type:
            raise ValueError(
                f"{self.kind} term {name!r} returns a tensor on {value_E.device}: expected {device}"
            )
        return value_E

    def rehearse(self) -> None:
        """Run each term once more; the caller puts back what changes."""
        self._values()


def _staged(kind: str, name: str, terms: Mapping[str, Any], stages: Sequence[Fields]) -> list[Any]:
    """Return a term's later stages: each has the fields of all stages up to it."""
    check_known(f"{kind} that a curriculum adapts", name, terms)
    term = terms[name]
    known = {field.name for field in dataclasses.fields(term)} - {"weight", "time_out"}
    later = []
    for fields in stages:
        for field in fields:
            check_known(f"field of {kind} {name!r} that stages can change", field, known)
        term = dataclasses.replace(term, **fields)
        later.append(term)
    return later


class RewardManager(_OutcomeManager):
    """Computes the weighted terms and their sums over the episode.

    Weights live on the device, so that a curriculum can change them inside a captured step. A term of weight 0 is not
    computed, unless a term of the curriculum adapts it.
    """

    kind = "reward"

    def __init__(
        self,
        terms: Mapping[str, RewardTerm],
        driver: EnvDriver,
        *,
        scale: float,
        curriculum: Mapping[str, CurriculumTerm],
    ) -> None:
        adapted = {name for term in curriculum.values() for name in term.adapted_rewards}
        unknown = sorted(adapted - terms.keys())
        if unknown:
            raise ValueError(
                f"a curriculum adapts the unknown reward {unknown[0]!r}: {near(unknown[0], terms)}"
            )
        # Left out here, so that a term of weight 0 costs nothing and may even be invalid.
        computed = {
            name: term for name, term in terms.items() if term.weight != 0.0 or name in adapted
        }
        super().__init__(computed, driver, curriculum)
        self._scale = scale
        # One tensor, of whose elements curricula get windows below.
        self.weights_R = torch.tensor(
            [term.weight for term in computed.values()], device=driver.view.device
        )
        self.episode_sums_ER = driver.view.buffers.get(
            "rewards.episode_sums_ER", len(self.names), owner=ENV
        )
        driver.readings.reward_weights.update(zip(self.names, self.weights_R.unbind(), strict=True))
        driver.readings.episode_rewards.update(
            zip(self.names, self.episode_sums_ER.unbind(-1), strict=True)
        )
        # Run once, so that wrong names and shapes are errors now.
        self.step(self._everybody_E())

    def step(self, finite_E: Bool[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the reward of the current state, float32 [E]; rows whose physics failed get 0."""
        values = self._values()
        if not values:
            return torch.zeros(self._view.num_envs, device=self._view.device)
        # One table, so that weights, sums and the watch for NaN are one kernel each.
        value_ER = torch.stack(values, dim=-1)
        self._driver.non_finite.watch(self.kind, value_ER, self.names)
        weighted_ER = value_ER * (self.weights_R * self._scale)
        # Failed rows give 0 before the sums, where a NaN would stay until the log is cleared.
        weighted_ER = torch.where(finite_E[:, None], weighted_ER, 0.0)
        # A number that is not finite stays in the reward and is named; in the sums it would hide all others.
        self.episode_sums_ER.add_(torch.nan_to_num(weighted_ER, nan=0.0, posinf=0.0, neginf=0.0))
        return weighted_ER.sum(-1)


class TerminationManager(_OutcomeManager):
    """Combines the termination terms with the guard against non-finite physics."""

    kind = "termination"

    def __init__(
        self,
        terms: Mapping[str, TerminationTerm],
        driver: EnvDriver,
        *,
        is_finite_horizon: bool,
        curriculum: Mapping[str, CurriculumTerm],
    ) -> None:
        super().__init__(terms, driver, curriculum)
        num_envs = driver.view.num_envs
        device = driver.view.device
        self._is_finite_horizon = is_finite_horizon
        # The guard is the last column, a failure and never a time-out.
        self.names = (*terms, "non_finite")
        self.flags_EK = torch.zeros(num_envs, len(self.names), dtype=torch.bool, device=device)
        driver.readings.terminations.update(zip(self.names, self.flags_EK.unbind(-1), strict=True))
        self._time_out_K = torch.tensor(
            [term.time_out for term in terms.values()] + [False], device=device
        )
        self._failure_K = ~self._time_out_K
        self.step(self._everybody_E())

    def step(self, finite_E: Bool[Tensor, " E"]) -> tuple[Bool[Tensor, " E"], Bool[Tensor, " E"]]:
        """Return `terminated` and `truncated` of the current state; a row may be both, and the first ends the return.

        Rows whose physics failed are terminated.
        """
        # In place: `view.terminations` are windows onto the columns.
        self.flags_EK.copy_(torch.stack((*self._values(torch.bool), ~finite_E), dim=-1))
        timed_out_E = (self.flags_EK & self._time_out_K).any(-1)
        failed_E = (self.flags_EK & self._failure_K).any(-1)
        self._driver.readings.terminated_E.copy_(failed_E)
        self._driver.readings.truncated_E.copy_(timed_out_E)
        # Time is part of the task, so running out of it ends the return, too.
        if self._is_finite_horizon:
            return failed_E | timed_out_E, torch.zeros_like(timed_out_E)
        return failed_E, timed_out_E


class MetricManager(_OutcomeManager):
    """Accumulates each metric over the running episodes as its term asks: mean, last, max or sum.

    Which of these occur is known at construction, and the others cost nothing in a step.
    """

    kind = "metric"

    def __init__(self, terms: Mapping[str, MetricTerm], driver: EnvDriver) -> None:
        super().__init__(terms, driver)
        self.held_EM = driver.view.buffers.get("metrics.held_EM", len(self.names), owner=ENV)
        reductions = [term.reduce for term in terms.values()]
        self._occurring = frozenset(reductions)
        # Masks of columns [M], made once: a step picks by `where`, without branches.
        self._is_mean_M, self._is_last_M, self._is_max_M = (
            torch.tensor(
                [given == kind for given in reductions], dtype=torch.bool, device=driver.view.device
            )
            for kind in ("mean", "last", "max")
        )
        # Sums over the substeps of an env step, of the terms that are read there.
        self._sums = {
            name: driver.view.buffers.get(f"metrics/{name}.substeps_E", owner=ENV)
            for name, term in terms.items()
            if term.per_substep
        }
        self._substeps = round(driver.step_dt / driver.physics_dt)
        if self._sums:
            driver.after_substep.append(self.substep)
            # Once as within an env step, so that what cannot be read there is an error now.
            self.substep()
            driver.refreshed()
        self.step(self._everybody_E())

    def substep(self) -> None:
        """Take in the values after a physics substep."""
        # The state is another one; what derives from it follows at the end of the env step.
        self._driver.changed()
        for name, sum_E in self._sums.items():
            sum_E.add_(self._called(name, self._terms[name], f"metrics/{name}", None))

    def _value(self, name: str, term: MetricTerm, dtype: torch.dtype | None) -> Tensor:
        if not term.per_substep:
            return super()._value(name, term, dtype)
        mean_E = self._sums[name] / self._substeps
        self._sums[name].zero_()
        return mean_E

    def step(self, finite_E: Bool[Tensor, " E"]) -> None:
        """Take in the values of the current state; rows whose physics failed add nothing."""
        values = self._values()
        if not values:
            return
        value_EM = torch.where(finite_E[:, None], torch.stack(values, dim=-1), 0.0)
        self._driver.non_finite.watch(self.kind, value_EM, self.names)
        held_EM = self.held_EM
        # A running sum serves both "sum" and "mean".
        next_EM = held_EM + value_EM
        if "last" in self._occurring:
            next_EM = torch.where(self._is_last_M, value_EM, next_EM)
        if "max" in self._occurring:
            # Buffers start at 0, which would hide a peak below 0.
            is_first_E1 = self._view.episode_step_E[:, None] <= 1
            peak_EM = torch.maximum(torch.where(is_first_E1, value_EM, held_EM), value_EM)
            next_EM = torch.where(self._is_max_M, peak_EM, next_EM)
        held_EM.copy_(next_EM)

    @property
    def reduced_EM(self) -> Float[Tensor, "E M"]:
        """The reduced values of the episodes so far, float32 [E, M]."""
        if "mean" not in self._occurring:
            return self.held_EM
        # A row at step 0 has no values yet, and must not divide by 0.
        mean_EM = self.held_EM / self._view.episode_step_E[:, None].clamp(min=1)
        return torch.where(self._is_mean_M, mean_EM, self.held_EM)


class CurriculumManager(_OutcomeManager):
    """Keeps the latest level of each curriculum on the device; two that drive `view.level` are refused."""

    kind = "curriculum"

    def __init__(self, terms: Mapping[str, CurriculumTerm], driver: EnvDriver) -> None:
        super().__init__(terms, driver)
        drivers = {
            name: term.first_level for name, term in terms.items() if term.first_level is not None
        }
        if len(drivers) > 1:
            raise ValueError(
                f"curriculum: {' and '.join(drivers)} all drive the one level: keep one of them"
            )
        for level in drivers.values():
            driver.readings.level.fill_(level)
        self.levels_C = torch.zeros(len(self.names), device=driver.view.device)
        # For no row, so that wrong names and shapes are errors now.
        self.reset(~self._everybody_E())

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Adapt to the episodes that just ended in the rows of `mask_E`."""
        for index, (name, term) in enumerate(self._terms.items()):
            scope = f"curriculum/{name}"
            counter = self._view.reset_count_E
            with self._driver.scope(scope, counter, part=term, mask_E=mask_E):
                level = term(self._view, mask_E)
            if not isinstance(level, Tensor):
                raise ValueError(
                    f"curriculum term {name!r} returns {type(level).__name__}: expected a tensor (), one level for all "
                    "envs"
                )
            if level.shape != ():
                raise ValueError(
                    f"curriculum term {name!r} returns shape {tuple(level.shape)}: expected (), one level for all envs"
                )
            # Level is a device tensor: nothing is read by the host.
            self.levels_C[index].copy_(level)

    def levels(self) -> dict[str, Float[Tensor, ""]]:
        """Return the latest level of each curriculum."""
        return dict(zip(self.names, self.levels_C.unbind(), strict=True))

    def rehearse(self) -> None:
        """Adapt to no episode, which changes nothing."""
        # The level is written even where no row resets, so it is put back.
        levels_C = self.levels_C.clone()
        self.reset(~self._everybody_E())
        self.levels_C.copy_(levels_C)


class EpisodeLog:
    """One vector of sums over the episodes that ended since the last `clear`, kept on the device until it is read.

    Entries: `episodes` (count), `length_sum` (env steps), `return_sum`, `reward/<term>` (weighted sums over the
    episode), `termination/<term>` (counts), `metric/<term>` (reduced values); `non_finite_terms` since the start.
    """

    def __init__(
        self,
        driver: EnvDriver,
        rewards: RewardManager,
        terminations: TerminationManager,
        metrics: MetricManager,
    ) -> None:
        view = driver.view
        self._view = view
        self._rewards = rewards
        self._terminations = terminations
        self._metrics = metrics
        self._num_non_finite = driver.non_finite.num_terms
        parts = {
            "reward": rewards.names,
            "termination": terminations.names,
            "metric": metrics.names,
        }
        of_terms = [f"{kind}/{name}" for kind, names in parts.items() for name in names]
        self.names = ("episodes", "length_sum", "return_sum", *of_terms)
        self.totals_N = torch.zeros(len(self.names), device=view.device)

    def step(self, done_E: Bool[Tensor, " E"]) -> None:
        """Add the episodes that end now, bool [E]."""
        # One table [E, N] of all entries, masked and summed once: far fewer kernels than one sum per entry.
        done_E1 = done_E[:, None]
        sums_ER = self._rewards.episode_sums_ER
        rows_EN = torch.cat(
            (
                torch.ones_like(done_E1, dtype=torch.float32),
                self._view.episode_step_E[:, None],
                sums_ER.sum(-1, keepdim=True),
                sums_ER,
                self._terminations.flags_EK,
                self._metrics.reduced_EM,
            ),
            dim=-1,
        )
        self.totals_N.add_(torch.where(done_E1, rows_EN, 0.0).sum(0))

    def read(self) -> dict[str, Float[Tensor, ""]]:
        """Return the sums by name, float32 [] each, still on the device."""
        sums = dict(zip(self.names, self.totals_N.unbind(), strict=True))
        return sums | {"non_finite_terms": self._num_non_finite()}

    def running(self) -> dict[str, Float[Tensor, " E"] | Bool[Tensor, " E"]]:
        """Return reward sums, metrics and termination flags of the running episodes, [E] each, written in place."""
        values: dict[str, Tensor] = {}
        for name, sum_E in self._view.episode_rewards.items():
            values[f"rewards.{name}"] = sum_E
        for name, held_E in zip(self._metrics.names, self._metrics.held_EM.unbind(-1), strict=True):
            values[f"metrics.{name}"] = held_E
        for name, flag_E in self._view.terminations.items():
            values[f"terminations.{name}"] = flag_E
        return values

    def clear(self) -> None:
        """Start the sums again at 0."""
        self.totals_N.zero_()
