"""Keeps the recorded step of an env equal to the env's own Python, for as long as rollouts go on."""

import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from ksim_rl import ranks
from ksim_rl.collectors.compiled_step import CompiledStep
from ksim_rl.collectors.graph_step import GraphStep
from ksim_rl.collectors.step_check import StepCheck, shortened
from ksim_rl.compiled.differences import equal
from ksim_rl.compiled.python_watch import Change, listed
from ksim_rl.device.capture import Captured
from ksim_rl.device.streams import waiting_allowed
from ksim_rl.envs.contract import SimulatedWorld, part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.recorded_python import EAGER, KEEP, FrozenPythonError, RecordedPython

Policy = Callable[[TensorDictBase], TensorDictBase]
Act = Callable[[], TensorDictBase]
"""Returns the policy's output for the present root; random numbers drawn meanwhile are put back."""


class Recording:
    """The recorded step of an env: kernels, if it `compiles`, and on CUDA the `graph` of whole rollouts.

    It is made again when the Python that it was made from has changed. If changes come again and again, it waits longer
    each time, and the env's own Python runs meanwhile. Changes that show only in the numbers are found by comparing the
    recorded step with the env's own after 1, 2, 4, 8 ... rollouts: such a change is noticed after at most as many
    rollouts as there were before it.

    Attributes:
        compiled_step: the kernels, if there are any.
    """

    def __init__(self, env: EnvBase, policy: Policy, *, compiles: bool, graph: Captured) -> None:
        self._env = env
        self._compiles = compiles
        self._graph = graph
        self._has_graph = graph.device.type == "cuda" and not graph.is_eager
        # With values by term, a difference can be reported by the name of a term.
        inner = part(env, ManagerBasedRlEnv)
        if inner is None:
            self._by_term = dict
        else:
            self._by_term = inner.values_by_term
        # Other envs cannot be put back to where they were before a comparison.
        self._can_return = part(env, SimulatedWorld) is not None
        # On CUDA the graph of a rollout also freezes the policy's Python.
        if self._has_graph:
            others = {"policy": policy}
        else:
            others = {}
        self._python = RecordedPython(env, others, is_compared=compiles or self._can_return)
        self.compiled_step: CompiledStep | None = None
        self._graph_step: GraphStep | None = None
        # How many recordings were dropped, and for how many rollouts the next one waits.
        self._times = 0
        self._waiting = 0
        # Since the last recording.
        self._rollouts = 0
        self._agreed_after = 0

    @property
    def wants_kernels(self) -> bool:
        """Whether the env's step is to be compiled before the next rollout."""
        return self._compiles and self.compiled_step is None and not self._waiting

    @property
    def unchecked_rollouts(self) -> int:
        """How many rollouts have been made since the recorded step was last seen to be the env's own."""
        return self._rollouts - self._agreed_after

    def compile(self, root_E: TensorDictBase, act: Act) -> None:
        """Compile the env's step; where that cannot be done, say so, and leave it to graphs or to Python.

        A FrozenPythonError where Python changes from step to step; see `RecordedPython`.
        """
        # Python that cannot be recorded is refused here, with a message that names it.
        self._try_python(root_E, act)
        try:
            self.compiled_step = CompiledStep(
                self._env, root_E, act(), nan_ends_rows=self._can_return, by_term=self._by_term
            )
        except RuntimeError as error:
            self._compiles = False
            warnings.warn(
                f"THE ENV'S STEP IS NOT COMPILED, and slower: {error}", RuntimeWarning, stacklevel=3
            )

    def calling(self) -> AbstractContextManager[None]:
        """Return a context for a step of policy and env in Python: the first steps show whether it can be recorded."""
        if self._python.is_known or not self._records:
            return nullcontext()
        return self._python.calling()

    def before_rollout(self, root_E: TensorDictBase, act: Act) -> list[Change]:
        """Return the changes in Python since the recording, which is dropped if there are any.

        A FrozenPythonError where a change is without effect, or where a comparison shows one that was not seen.
        """
        if not (self._records and self._python.is_known):
            return []
        # Cheap, some tens of microseconds, so it runs before each rollout.
        changes = self._python.changes()
        if changes:
            self._forget(changes)
        # Nothing changed in this rollout: count down, and let the graph be captured when the wait is over.
        elif self._waiting:
            self._waiting -= 1
            self._graph.is_eager = self._waiting > 0
        elif self._is_recorded:
            # It happens so seldom that it may wait for the device.
            with waiting_allowed(self._graph.device):
                self._check(root_E, act)
            self._rollouts += 1
        return changes

    @property
    def _records(self) -> bool:
        return self._compiles or self._has_graph

    @property
    def _is_recorded(self) -> bool:
        return self.compiled_step is not None or self._graph.ready

    def _try_python(self, root_E: TensorDictBase, act: Act) -> None:
        """Make the first steps of env and policy in Python and undo them, which is cheaper than a failed recording."""
        check = StepCheck(self._env, root_E, act())
        with check.left_alone():
            while not self._python.is_known:
                with self.calling():
                    if self._has_graph:
                        act()
                    check.own_step()

    def _forget(self, changes: list[Change]) -> None:
        """Drop the recordings, and wait with the next one if this is not the first time."""
        # 0, 1, 3, 7 ... rollouts: twice as long after each recording that was dropped.
        self._times += self._is_recorded
        self._waiting = (1 << max(self._times - 1, 0)) - 1
        what = f"{listed(changes)} since the env's step was recorded: it is recorded again"
        if self._waiting:
            what = (
                f"{listed(changes)}, and it is not the first change since the env's step was recorded: the Python of "
                f"each step runs, which is SLOWER, until nothing has changed for {self._waiting} rollouts. {KEEP}"
            )
        warnings.warn(what, RuntimeWarning, stacklevel=4)
        # Both recordings hold the old Python, and so do the remembered values.
        self._drop()
        self._python.forget()
        self._rollouts = self._agreed_after = 0

    def _drop(self) -> None:
        self.compiled_step = self._graph_step = None
        self._graph.forget()
        self._graph.is_eager = self._waiting > 0

    def _check(self, root_E: TensorDictBase, act: Act) -> None:
        """Compare the recorded step with the env's own, if it is time to."""
        if not self._can_return:
            return
        # Taken right after the graph of the rollout, while Python is still the same as in the graph.
        if self.compiled_step is None and self._graph_step is None:
            self._graph_step = GraphStep(
                self._env, root_E, act(), nan_ends_rows=True, by_term=self._by_term
            )
        # Only at powers of two, so that comparisons cost less and less of a long run.
        if self._rollouts.bit_count() != 1:
            return
        step = self.compiled_step or self._graph_step
        assert step is not None
        # Both steps start from the same state and draws, and the env is restored afterwards.
        found = step.differences()
        if not found:
            self._agreed_after = self._rollouts
            return
        # It is not known in which of these rollouts the change happened.
        suspects = self.unchecked_rollouts
        names = shortened(found)
        if self.compiled_step is not None and self._kernels_are_wrong(root_E, act):
            self._compiles = False
            self._drop()
            warnings.warn(
                f"THE ENV'S STEP IS NOT COMPILED any more, and slower: in this state its kernels give another "
                f"{names} than the env; they have made the last {suspects} rollouts",
                RuntimeWarning,
                stacklevel=4,
            )
            return
        raise FrozenPythonError(
            f"the env's own step gives another {names} than what was recorded of it {self._rollouts} rollouts "
            f"ago, though no Python value has changed that can be seen (it may be in a file or a library): the last "
            f"{suspects} rollouts may be of what it was then. {KEEP}; {EAGER}",
            rollouts=suspects,
        )

    def _kernels_are_wrong(self, root_E: TensorDictBase, act: Act) -> bool:
        """Whether kernels that are made now from the env's Python do the same as the present ones, which they replace.

        Then no Python has changed since: the kernels differ from the env in this state.
        """
        present = self.compiled_step
        assert present is not None
        given = present.given()
        outcome = present.outcome(given)
        self._drop()
        self.compile(root_E, act)
        if self.compiled_step is None:
            # They do not even agree with the env at another action.
            return True
        changed = not equal(self.compiled_step.outcome(given), outcome)
        # All ranks go on in the same way: it is enough that one of them sees another Python.
        return not ranks.any_of(torch.tensor([changed], device=self._graph.device))
