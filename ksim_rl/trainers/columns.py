"""This module checks that a checkpoint's networks read what this run's env shows."""

from collections.abc import Mapping, Sequence

Columns = Mapping[str, Mapping[str, Sequence[int]]]


def check_columns(saved: Columns, own: Columns) -> None:
    """Refuse observations with other terms or other columns than the checkpoint's; both are group -> term -> range.

    Raises:
        ValueError: naming the terms that only one of the two has, or whose columns differ.
    """
    faults = []
    for group in dict.fromkeys([*saved, *own]):
        theirs, ours = saved.get(group, {}), own.get(group, {})
        surplus, missing = [n for n in theirs if n not in ours], [n for n in ours if n not in theirs]
        moved = [name for name in theirs if name in ours and list(theirs[name]) != list(ours[name])]
        if surplus:
            faults.append(f"group {group!r}: only the checkpoint has {', '.join(surplus)}")
        if missing:
            faults.append(f"group {group!r}: only this run has {', '.join(missing)}")
        if moved and not surplus and not missing:
            places = ", ".join(f"{n} at {list(theirs[n])}, here {list(ours[n])}" for n in moved)
            faults.append(f"group {group!r}: the checkpoint has {places}")
    if faults:
        raise ValueError(f"the checkpoint is of other observations: {'; '.join(faults)}")
