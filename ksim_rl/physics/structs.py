"""Kernels take many arrays of a model and its worlds as one Warp struct, whose fields this module makes and fills."""

from collections.abc import Callable, Mapping
from typing import Any

import warp as wp


def struct_with(*parts: tuple[str, type, str]) -> Callable[[type], Any]:
    """Make a class a Warp struct that has, besides its own fields, some of MuJoCo Warp's dataclasses.

    Args:
        parts: each with what comes before the names, the dataclass, and the names of its fields, with blanks between.
    """

    def decorate(cls: type) -> Any:
        for prefix, owner, names in parts:
            types = owner.__annotations__
            cls.__annotations__.update({prefix + name: types[name] for name in names.split()})
        return wp.struct(cls)

    return decorate


def filled(struct: Any, *owners: object) -> Any:
    """Return a struct in which each field is that of its name in the first owner that has it."""
    fields = [owner if isinstance(owner, Mapping) else vars(owner) for owner in owners]
    instance = struct()
    for name in struct.vars:
        setattr(instance, name, next(owned[name] for owned in fields if name in owned))
    return instance
