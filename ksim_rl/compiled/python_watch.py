"""Notices when Python values change that a recorded step was made from, and names them."""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from operator import is_
from typing import Any

import torch
from torch import Tensor

from ksim_rl.compiled.python_states import PLAIN
from ksim_rl.compiled.python_values import ABSENT, Held, Parts, held_by

LONGEST = 60
"""Characters of a value in a text."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Change:
    """A value that has changed.

    `owner` has it under `key`; `names` are its paths, one from each part that depends on it.
    """

    names: tuple[str, ...]
    owner: Any
    key: Hashable
    before: Any
    now: Any

    @property
    def is_of_tensors(self) -> bool:
        """Whether a tensor is in the place of another one."""
        return isinstance(self.before, Tensor) and isinstance(self.now, Tensor)

    def __str__(self) -> str:
        """Return its name, with both values where their texts differ."""
        where = " and ".join(self.names[:3])
        if len(self.names) > 3:
            where += f" and {len(self.names) - 3} more"
        before = _shown(self.before)
        now = _shown(self.now)
        if before == now:
            return f"{where} is another object"
        return f"{where} was {before} and is {now}"


class PythonWatch:
    """The Python values that some parts depend on, as they were when it last looked.

    Parts are objects by name: terms, transforms, networks. Looking for all values takes some milliseconds; asking
    whether any of them has changed takes some tens of microseconds, since unchanged values are recognized by identity.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._held: list[_Remembered] = []

    def look(self, parts: Parts) -> None:
        """Look for all values that the parts depend on now, and remember them."""
        self._held = [_Remembered.of(held) for held in held_by(parts, self._device)]

    def changes(self) -> list[Change]:
        """Return the changes since the last `look`."""
        found: list[Change] = []
        for remembered in self._held:
            if remembered.is_the_same():
                continue
            held = remembered.held
            before = remembered.before
            now = held.read()
            # Keys that are gone and keys that are new count as changes, too.
            for key in dict.fromkeys((*before, *now)):
                old = before.get(key, ABSENT)
                new = now.get(key, ABSENT)
                if _is_same(old, new):
                    continue
                names = tuple(held.spell(path, key) for path in held.paths)
                found.append(Change(names=names, owner=held.owner, key=key, before=old, now=new))
        return found


@dataclass(frozen=True, eq=False)
class _Remembered:
    """Values in one place as they were: by key, and in order. `size` is the length of the table that they are from."""

    held: Held
    before: dict[Hashable, Any]
    values: list[Any]
    size: int

    @classmethod
    def of(cls, held: Held) -> "_Remembered":
        # A copy, as `read` may return the live table.
        before = dict(held.read())
        if held.table is None:
            size = -1
        else:
            size = len(held.table)
        return cls(held, before, list(before.values()), size)

    def is_the_same(self) -> bool:
        """Whether each value is the same as before; False also where that takes a closer look."""
        table = self.held.table
        pick = self.held.pick
        if table is None or len(table) != self.size:
            now = self.held.read()
            # Numbers that are worked out are other objects each time.
            return len(now) == len(self.values) and all(map(_is_same, now.values(), self.values))
        # The whole table is watched, so its values are compared in order.
        if pick is None:
            return all(map(is_, table.values(), self.values))
        try:
            return all(map(is_, pick(table), self.values))
        # A name was deleted and another one added.
        except KeyError:
            return False


def listed(changes: Iterable[Change], *, most: int = 4) -> str:
    """Return the changes as one text."""
    texts = list(dict.fromkeys(map(str, changes)))
    # A changed transform may change dozens of values: the first few tell enough.
    if len(texts) > most:
        more = f"; and {len(texts) - most} more"
    else:
        more = ""
    return "; ".join(texts[:most]) + more


def _is_same(old: Any, new: Any) -> bool:
    if old is new:
        return True
    kind = type(old)
    if kind is not type(new):
        return False
    # A tuple is made again at each reading; its items tell whether it has changed.
    if issubclass(kind, tuple):
        return len(old) == len(new) and all(map(_is_same, old, new))
    # Only for types that never change: two equal lists may be two lists that change later.
    return issubclass(kind, PLAIN) and bool(old == new)


def _shown(value: Any) -> str:
    if not issubclass(type(value), (*PLAIN, list, dict, tuple, set)):
        return f"a {type(value).__name__}"
    text = value if value is ABSENT else repr(value)
    if len(text) <= LONGEST:
        return text
    return f"{text[: LONGEST - 3]}..."
