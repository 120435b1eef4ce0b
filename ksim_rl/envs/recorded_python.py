"""Keeps a recorded step true to the Python that it was recorded from: changes are noticed and named."""

from collections.abc import Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torchrl.envs import EnvBase

from ksim_rl.compiled.host_calls import CLOCK, ENVIRONMENT, FILE, RANDOM, HostCall, host_calls
from ksim_rl.compiled.python_values import Part, Parts
from ksim_rl.compiled.python_watch import Change, PythonWatch, listed
from ksim_rl.device.capture import Captured
from ksim_rl.envs.python_parts import python_parts, why_not

INSTEAD = {
    CLOCK: "tell the time by `view.episode_time_E` or `view.step_count`",
    RANDOM: "draw by `view.uniform`, `view.normal` or `view.integers`",
    FILE: "read files while the env is built, in `__post_init__` of the term",
    ENVIRONMENT: "read the environment while the env is built, in `__post_init__` of the term",
}
KEEP = (
    "Keep what changes in `view.buffer` (a row per env) or `view.shared`, and count by `view.step_count` or "
    "`view.episode_step_E`"
)
EAGER = "or let the Python of each step run, which takes longer: collector.eager=true"


class FrozenPythonError(ValueError):
    """Raised for Python that a recording would freeze, or has frozen; the message names it, and an alternative.

    The last `rollouts` may have been made with frozen Python.
    """

    def __init__(self, message: str, *, rollouts: int = 0) -> None:
        super().__init__(message)
        self.rollouts = rollouts


class RecordedPython:
    """The Python that steps of an env run, from the first step on.

    A recorded step (kernels, a CUDA graph) runs none of it. So it has to be the same at each step, which the second
    step shows: `calling` is around each of the first ones. After those, `changes` names the values that a program has
    changed from outside, such as an attribute of a term, or one more transform; then the step has to be recorded again.

    `others` are objects whose Python becomes part of the recording as well, by name: a policy. A step that puts a
    tensor in the place of another one may still be recorded, if it writes it before it reads it. Where the numbers of
    the recording are compared with Python's, `is_compared`, the comparison decides; else it is refused as well.
    """

    def __init__(
        self, env: EnvBase, others: Parts | None = None, *, is_compared: bool = False
    ) -> None:
        self._env = env
        self._others = dict(others or {})
        self._is_compared = is_compared
        self._watch = PythonWatch(env.device or torch.device("cpu"))
        self._calls = 0
        # Places in which each step puts another tensor.
        self._replaced: set[tuple[int, Hashable]] = set()

    @property
    def is_known(self) -> bool:
        """Whether two steps have shown all that Python does."""
        return self._calls >= 2

    @contextmanager
    def calling(self) -> Iterator[None]:
        """Enclose one of the first steps; a FrozenPythonError after the second where it changed or asked the host.

        The first one's changes may be caches that it fills.
        """
        # The first step may fill caches; only the second one is judged.
        if self._calls != 1:
            yield
        else:
            with host_calls(self._parts()) as calls:
                yield
            # Compared with the values right after the first step.
            changes = self._watch.changes()
            if self._is_compared:
                self._replaced = {_place(change) for change in changes if change.is_of_tensors}
            # Replaced tensors are judged by the comparison of numbers, if there is one.
            self._refuse(
                calls, [change for change in changes if _place(change) not in self._replaced]
            )
        self._calls += 1
        # Values as they are after this step: later changes come from outside.
        self._watch.look(self._parts())

    def forget(self) -> None:
        """Let the next two steps show Python's work again."""
        self._calls = 0

    def changes(self) -> list[Change]:
        """Return the changes since the last `look`; a FrozenPythonError for one that cannot have an effect any more."""
        found = [change for change in self._watch.changes() if _place(change) not in self._replaced]
        for change in found:
            instead = why_not(change)
            # A change without any effect is worse than an error: the user believes that it works.
            if instead is not None:
                raise FrozenPythonError(f"{change}, without effect: {instead}")
        return found

    def _parts(self) -> dict[str, Part]:
        return python_parts(self._env) | self._others

    def _refuse(self, calls: Sequence[HostCall], changes: Sequence[Change]) -> None:
        # Calls first: they are the cause, and a changed value is often their effect.
        if calls:
            found = "; ".join(dict.fromkeys(map(str, calls[:3])))
            instead = INSTEAD[calls[0].what]
            raise FrozenPythonError(
                f"{found}: its answer would be frozen, since the Python of a step runs while that is recorded, and no "
                f"more. Instead {instead}; {EAGER}"
            )
        if changes:
            raise FrozenPythonError(
                f"{listed(changes)} after one step more: it would be frozen, since the Python of a step runs while "
                f"that is recorded, and no more. {KEEP}; {EAGER}"
            )


def _place(change: Change) -> tuple[int, Hashable]:
    return id(change.owner), change.key


class FollowedGraph:
    """A CUDA graph of a step of an env, recorded again when the Python that it was recorded from has changed.

    On the CPU, and where graphs are not wanted, Python runs at each step, and there is nothing to follow. For `others`
    see `RecordedPython`.
    """

    def __init__(self, env: EnvBase, graph: Captured, others: Parts | None = None) -> None:
        self._graph = graph
        self._python = RecordedPython(env, others)
        self._records = graph.device.type == "cuda" and not graph.is_eager

    def calling(self) -> AbstractContextManager[None]:
        """Return a context for a step in Python; see `RecordedPython`."""
        if self._python.is_known or not self._records:
            return nullcontext()
        return self._python.calling()

    def follow(self) -> None:
        """Forget the graph if Python has changed; a FrozenPythonError if that cannot have an effect any more."""
        if self._records and self._python.is_known and self._python.changes():
            # The next call is eager again, then the graph is captured from the new Python.
            self._graph.forget()
            self._python.forget()
