"""Named quantities of the current state, each computed at most once per step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from jaxtyping import Shaped
from torch import Tensor


class HasCache(Protocol):
    """What owns quantities: a dict that is emptied whenever the state changes."""

    cache: dict[str, Tensor]


def quantity(compute: Callable[[Any], Shaped[Tensor, "*shape"]]) -> property:
    """Make a property that is computed at most once between two changes of the state."""
    name = compute.__name__

    def read(owner: HasCache) -> Tensor:
        value = owner.cache.get(name)
        if value is None:
            value = owner.cache[name] = compute(owner)
        return value

    return property(read, doc=compute.__doc__)
