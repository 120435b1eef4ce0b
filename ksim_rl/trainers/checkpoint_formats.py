"""Formats of checkpoints: what each version changed, and how an older state becomes a present one."""

from collections.abc import Callable
from typing import Any

from ksim_rl.trainers.state_tree import State

FORMAT_VERSION = 2


def _add_hooks(state: State) -> State:
    """Version 2 keeps the state of a user's hooks, of which version 1 had none."""
    return {**state, "hooks": {}}


# From each older version to the one after it; what has no entry is refused.
MIGRATIONS: dict[int, Callable[[State], State]] = {1: _add_hooks}


def refusal(version: Any) -> str | None:
    """Return why a version cannot be read, or None if it can."""
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        return f"checkpoint format {version!r}: expected a whole number from 1 to {FORMAT_VERSION}"
    if version > FORMAT_VERSION:
        return (
            f"checkpoint format {version}, this version reads up to {FORMAT_VERSION}: "
            "load it with the newer ksim_rl that wrote it"
        )
    missing = [step for step in range(version, FORMAT_VERSION) if step not in MIGRATIONS]
    if missing:
        return (
            f"checkpoint format {version}, and there is no way from {missing[0]} to {missing[0] + 1}: "
            "load it with the version of ksim_rl that wrote it"
        )
    return None


def migrate(state: State, version: int) -> State:
    """Bring a state from `version` to the present one, step by step."""
    for step in range(version, FORMAT_VERSION):
        state = MIGRATIONS[step](state)
    return state
