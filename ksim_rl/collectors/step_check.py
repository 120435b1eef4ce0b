"""Compares a recorded step of an env with the step that the env's own Python makes from the same state."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.utils._pytree import PyTree
from torchrl.envs import EnvBase

from ksim_rl import ranks
from ksim_rl.compiled.differences import NamedLeaves, differences
from ksim_rl.compiled.rounding import Nudging, nudged
from ksim_rl.device.state_tree import State

# `last_root` is not state, and a recorded step returns it in other memory. The peak contact counts under `overflow`
# change with the smallest difference in one world.
_LEFT_OUT = ("last_root.", "overflow/")
EVERY = 7
"""One row in so many gets a NaN action, where a NaN action ends the episode."""


def _unchanged(value: PyTree) -> PyTree:
    return value


@dataclass(frozen=True, eq=False)
class _State:
    """The start of a step: the state of the env, the root, and the policy's leaves."""

    env: State
    root_E: TensorDictBase
    given: dict[NestedKey, Tensor]


class StepCheck:
    """Makes the env's own step in the memory that a recorded one uses, and compares the two.

    `root_E` is the EnvState before a step; the next root is written into its memory. `tensordict` is the policy's
    output for it; the leaves that the policy added are copied to `given`, where each step reads them. `by_term` returns
    tensors that each step writes in place, by the name of their term, which is reported where they differ. With
    `nan_ends_rows` a row whose action is NaN ends its episode, which `rows_ending` makes use of.
    """

    def __init__(
        self,
        env: EnvBase,
        root_E: TensorDictBase,
        tensordict: TensorDictBase,
        *,
        nan_ends_rows: bool = False,
        by_term: Callable[[], Mapping[str, Shaped[Tensor, "*?shape"]]] = dict,
    ) -> None:
        self._env = env
        self._nan_ends_rows = nan_ends_rows
        self._root_E = root_E
        self._by_term = by_term
        self._root_keys = list(root_E.keys(True, True))
        # A shallow copy: leaves of the root stay shared with `root_E`, the policy's are replaced below.
        self._tensordict = tensordict.copy()
        self.given: dict[NestedKey, Tensor] = {}
        for key in tensordict.keys(True, True):
            if key not in self._root_keys:
                # Dense and in separate memory, as later ones are copied here.
                self.given[key] = tensordict.get(key).clone(memory_format=torch.contiguous_format)
                self._tensordict.set(key, self.given[key])

    def own_step(self) -> TensorDictBase:
        """Make the env's own step, write the next root, and return the EnvState."""
        # A copy, since the env adds keys to the tensordict that it steps.
        env_state_E, next_root_E = self._env.step_and_maybe_reset(self._tensordict.copy())
        for key in self._root_keys:
            self._root_E.get(key).copy_(next_root_E.get(key))
        return env_state_E

    def differences(self, recorded_step: Callable[[], TensorDictBase]) -> list[str]:
        """Return the names of values that differ between the two steps, each with the number of rows.

        Both make the same draws. Afterwards env, root, the policy's leaves and torch's random numbers are as they were.
        """
        # Everything below is undone from this state.
        start = self._state()
        try:
            with self._draws_forgotten():
                # The env's own step is the reference.
                true = self._results(self.own_step())
            # The recorded step starts from the same bits and the same generator state.
            self._return_to(start)
            with self._draws_forgotten():
                found = self._results(recorded_step())

            # The reference again, from inputs that are off by some units in the last place: a row that reacts
            # strongly to that is chaotic, and may differ.
            def moved(number: int, units: int) -> NamedLeaves:
                generator = torch.Generator(self._env.device or "cpu").manual_seed(number)
                self._return_to(start, partial(_nudged, generator=generator, units=units))
                with self._draws_forgotten(), Nudging(generator, units=units):
                    env_state_E = self.own_step()
                return self._results(env_state_E)

            rows = differences(
                found,
                true,
                num_rows=self._env.batch_size[0],
                moved=moved,
                most_of=ranks.most_of,
            )
        # Also after an error, so that training can go on.
        finally:
            self._return_to(start)
        return [f"{name} in {number} rows" for name, number in rows.items()]

    def outcome(
        self,
        recorded_step: Callable[[], TensorDictBase],
        given: Mapping[NestedKey, Shaped[Tensor, "*?shape"]],
    ) -> NamedLeaves:
        """Return all results of a step from the present state, with these leaves of the policy.

        Afterwards env, root, the policy's leaves and torch's random numbers are as they were.
        """
        with self.left_alone():
            for key, value in given.items():
                self.given[key].copy_(value)
            return self._results(recorded_step())

    @contextmanager
    def rows_ending(self) -> Iterator[None]:
        """Let some rows, but never all of them, end their episodes in this block, so that resets are compared as well.

        In most steps no row ends by itself. A row with a NaN action repeats its last one, so nothing else is NaN.
        """
        action = None
        if self._nan_ends_rows:
            action = self.given.get(self._env.action_key)
        if action is None or not action.is_floating_point():
            yield
            return
        # Later steps may read the same memory, so the action is put back.
        held = action.clone()
        action[1::EVERY] = torch.nan
        try:
            yield
        finally:
            action.copy_(held)

    @contextmanager
    def left_alone(self) -> Iterator[None]:
        """Leave env, root and draws as they are now, whatever steps are made in this block."""
        start = self._state()
        try:
            with self._draws_forgotten():
                yield
        finally:
            self._return_to(start)

    def _draws_forgotten(self) -> AbstractContextManager[None]:
        device = self._env.device
        # Restores the CPU generator and the one of the env's own device.
        return torch.random.fork_rng(
            [device] if device is not None and device.type == "cuda" else []
        )

    def _state(self) -> _State:
        given = {key: value.clone() for key, value in self.given.items()}
        return _State(self._env.state_dict(), self._root_E.clone(), given)

    def _return_to(self, start: _State, change: Callable[[PyTree], PyTree] = _unchanged) -> None:
        """Restore a state, with `change` applied to each of its tensors."""
        self._env.load_state_dict({name: change(value) for name, value in start.env.items()})
        for key in self._root_keys:
            self._root_E.get(key).copy_(change(start.root_E.get(key)))
        for key, value in start.given.items():
            self.given[key].copy_(change(value))

    def _results(self, env_state_E: TensorDictBase) -> NamedLeaves:
        """Copy all results of a step: values of terms, the EnvState's `next`, the next root, the state of the env."""
        # First the values of terms, as the first differences are the ones that get reported.
        results = {name: value.clone() for name, value in self._by_term().items()}
        next_E = env_state_E.get("next")
        results |= {_spelled("next", key): leaf.clone() for key, leaf in next_E.items(True, True)}
        results |= {
            _spelled("root", key): leaf.clone() for key, leaf in self._root_E.items(True, True)
        }
        for name, value in self._env.state_dict().items():
            is_own = not any(left_out in name for left_out in _LEFT_OUT)
            if is_own and isinstance(value, Tensor):
                results[name] = value
        return results


def shortened(found: list[str]) -> str:
    """Return the first few names of values that differ, and how many more there are."""
    names = ", ".join(found[:3])
    if len(found) > 3:
        names += f" and {len(found) - 3} more"
    return names


def _nudged(value: PyTree, generator: torch.Generator, units: int) -> PyTree:
    if isinstance(value, Tensor):
        return nudged(value, generator, units=units)
    return value


def _spelled(tree: str, key: NestedKey) -> str:
    parts = (key,) if isinstance(key, str) else key
    return ".".join((tree, *map(str, parts)))
