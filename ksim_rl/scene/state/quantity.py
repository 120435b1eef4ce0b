"""Named quantities of the current state, each computed at most once per step."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Protocol

from torch import Tensor

from ksim_rl.scene.names import Index


class HasCache(Protocol):
    """What owns quantities: a dict that is emptied whenever the state changes."""

    cache: dict[str, Tensor]


def quantity(compute: Callable[[Any], Tensor]) -> property:
    """Make a property that is computed at most once between two changes of the state."""
    name = compute.__name__

    def read(owner: HasCache) -> Tensor:
        value = owner.cache.get(name)
        if value is None:
            value = owner.cache[name] = compute(owner)
        return value

    return property(read, doc=compute.__doc__)


def indexed_quantity(compute: Callable[[Any, Index], Tensor]) -> Callable[[Any, Index], Tensor]:
    """Make a method that is computed at most once per index between two changes of the state."""

    @wraps(compute)
    def read(owner: HasCache, index: Index) -> Tensor:
        if isinstance(index, slice):
            key = f"{compute.__name__}[{index.start}:{index.stop}:{index.step}]"
        else:
            key = f"{compute.__name__}[{id(index)}]"
            # Kept beside its values: while it lives, no other tensor can have its id.
            owner.cache[f"index {id(index)}"] = index
        value = owner.cache.get(key)
        if value is None:
            value = owner.cache[key] = compute(owner, index)
        return value

    return read
