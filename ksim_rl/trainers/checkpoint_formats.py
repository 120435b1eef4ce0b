"""Describes each format of checkpoints, and migrates an older one to the present one."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ksim_rl.device.state_tree import State, branch

FORMAT_VERSION = 2
Config = dict[str, Any]


def _from_1(state: State, config: Config) -> tuple[State, Config]:
    """Version 2 keeps the states of hooks and of recurrent networks, and the config in its own order.

    Version 1 had neither and sorted the config by name. The inputs of networks stand in the order of the observation
    terms, and that is the order of the columns, which version 1 kept.
    """
    update = branch(state, "update") if "update" in state else {}
    columns = branch(state, "observation_columns") if "observation_columns" in state else {}
    state = {**state, "hooks": {}, "update": {**update, "recurrent_state": {}}}
    task = config.get("task", {})
    observations = {
        name: _in_order_of(group, branch(columns, name) if name in columns else {})
        for name, group in task.get("observations", {}).items()
    }
    if observations:
        config = {**config, "task": {**task, "observations": observations}}
    return state, config


def _in_order_of(group: Mapping[str, Any], columns: State) -> dict[str, Any]:
    # By term its first column, which tells the order that the config of version 1 lost.
    starts: dict[str, int] = {}
    for column, span in columns.items():
        if isinstance(span, Sequence) and span and isinstance(span[0], int):
            starts[column.rpartition("/")[2]] = span[0]
    terms = group.get("terms", {})
    # Columns of another kind: better the order as it is than a wrong one.
    if not terms.keys() <= starts.keys():
        return dict(group)
    return {**group, "terms": {name: terms[name] for name in sorted(terms, key=starts.__getitem__)}}


# From each older version to the one after it; a version without an entry is refused.
MIGRATIONS: dict[int, Callable[[State, Config], tuple[State, Config]]] = {1: _from_1}


def refusal(version: Any) -> str | None:
    """Return why a version cannot be read, or None if it can."""
    # JSON's true is an int in Python.
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


def migrate(state: State, config: Config, *, version: int) -> tuple[State, Config]:
    """Bring state and config from `version` to the present one, step by step."""
    for step in range(version, FORMAT_VERSION):
        state, config = MIGRATIONS[step](state, config)
    return state, config
