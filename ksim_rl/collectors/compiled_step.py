"""Compiles the step of an env, resets included, whatever terms and transforms it is made of."""

from collections.abc import Callable, Mapping

from jaxtyping import Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.collectors.step_check import StepCheck, shortened
from ksim_rl.compiled.differences import NamedLeaves
from ksim_rl.compiled.tape import Tape
from ksim_rl.device.copying import copy_rows
from ksim_rl.device.recording import recorded

CHECKED_STEPS = 2
"""Steps that are compared before a compiled one is used: state that a step keeps outside of tensors shows in the
second one."""


class CompiledStep:
    """`env.step_and_maybe_reset` in few kernels: torch's operations between the launches of physics are compiled.

    `tensordict` is the policy's output for `root_E`, the EnvState before the step; the step writes the next root into
    the memory of `root_E`. The policy's leaves may lie elsewhere at each call. The constructor steps the env and then
    restores it. It raises a RuntimeError where the step cannot be recorded, or where the compiled step gives other
    numbers: the tolerance is 1e-4 relative, and more only in rows where the env's own step changes as much when its
    inputs move by some units in the last place, and in one row of 2,000.

    With `nan_ends_rows` a row whose action is NaN ends its episode, so that resets are compared as well. For
    `by_term` see `StepCheck`.
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
        # The check owns the static memory that the policy's leaves are copied to before each step.
        self._check = StepCheck(
            env, root_E, tensordict, nan_ends_rows=nan_ends_rows, by_term=by_term
        )
        self._given = self._check.given
        with self._check.left_alone():
            # One step in Python gives the list of torch operations and Warp launches.
            with recorded() as recorder:
                self.env_state_E = self._check.own_step()
            self._next_E = self.env_state_E.select("next")
            # The next root is copied to `root_E`, so only these leaves must outlive the kernels.
            returned = list(self._next_E.values(True, True))
            self._tape = Tape(recorder, num_rows=env.batch_size[0], returned=returned)
        with self._check.left_alone():
            # Compare, then step for real, so that the second comparison starts from another state.
            for _ in range(CHECKED_STEPS):
                self._refuse(self._check.differences(self._run))
                self._run()
            # The steps above may end no episode, and would leave the reset path unchecked.
            if nan_ends_rows:
                self._refuse(self.differences())

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Make a step, and reset the rows that are done: return the EnvState's `next`, and write the next root.

        The leaves lie in the same memory each time.
        """
        # The kernels hold fixed addresses: the policy's output is moved to them.
        copy_rows(list(self._given.values()), [tensordict.get(key) for key in self._given])
        return self._run()

    def differences(self) -> list[str]:
        """Return the differences from the env's own step in the present state, with the last action; see `StepCheck`.

        Some rows end in this step. Env, root and draws are left as they were.
        """
        with self._check.rows_ending():
            return self._check.differences(self._run)

    def given(self) -> dict[NestedKey, Shaped[Tensor, "*?shape"]]:
        """Return a copy of the policy's leaves of the step that `differences` compares."""
        with self._check.rows_ending():
            return {key: value.clone() for key, value in self._given.items()}

    def outcome(self, given: Mapping[NestedKey, Shaped[Tensor, "*?shape"]]) -> NamedLeaves:
        """Return all results of a step from the present state, with these leaves of the policy; nothing is changed."""
        return self._check.outcome(self._run, given)

    def _run(self) -> TensorDictBase:
        self._tape()
        return self._next_E

    @staticmethod
    def _refuse(found: list[str]) -> None:
        if found:
            raise RuntimeError(f"the compiled step gives another {shortened(found)} than the env")
