"""Makes named quantities of the current state, each computed at most once per step."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Shaped
from torch import Tensor


def quantity(compute: Callable[[Any], Shaped[Tensor, "*shape"]]) -> property:
    """Make a property that is computed once between two changes of the state, which empty its owner's `cache`."""
    name = compute.__name__

    def read(owner: Any) -> Tensor:
        value = owner.cache.get(name)
        # The owner's cache is emptied at each change of the state, so that a hit is current.
        if value is None:
            value = owner.cache[name] = compute(owner)
        return value

    read.__name__ = name
    # For callers that ask for the shape.
    read.__annotations__["return"] = compute.__annotations__["return"]
    return property(read, doc=compute.__doc__)


class QuantityOf(property):
    """A property that is a quantity of the object in the attribute `part`, in whose cache it stands as `cached_as`."""

    part: str
    cached_as: str
    whole: property


class FirstOf(property):
    """A property that is the first element's part of the quantity `whole` of several elements."""

    whole: property


def quantity_of(part: str, whole: property) -> QuantityOf:
    """Make a property that is the quantity `whole` of the object in the attribute `part`."""
    made = QuantityOf(lambda owner: whole.__get__(getattr(owner, part)), doc=whole.__doc__)
    # A subclass of property has its class's docstring otherwise.
    made.__doc__ = whole.__doc__
    # Kept for whoever asks which cache a read goes to.
    made.part = part
    made.whole = whole
    made.cached_as = getattr(whole.fget, "__name__", "")
    return made


def first_of(part: str, whole: property) -> FirstOf:
    """Make a property that is the first of the N elements whose quantity [E, N, ...] the object in `part` has."""
    # The part has a single element: [E, 1, ...] becomes [E, ...].
    made = FirstOf(lambda owner: whole.__get__(getattr(owner, part))[:, 0], doc=whole.__doc__)
    made.__doc__ = whole.__doc__
    made.whole = whole
    return made
