"""Kernels take many arrays of a model and its worlds as one Warp struct, whose fields this module makes and fills."""

from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.upstream import Struct

# The value of one field of a kernel's struct, and any object with such values as attributes.
Field: TypeAlias = wp.array | int | float
Owner: TypeAlias = Mapping[str, Field] | mjw.Model | mjw.Option | mjw.Data


def struct_with(*parts: tuple[str, type, str]) -> Callable[[type], Struct]:
    """Make a class a Warp struct that has, besides its own fields, some of MuJoCo Warp's dataclasses.

    Args:
        parts: each with a prefix of the names, the dataclass, and the names of its fields, with blanks between.
    """

    def decorate(cls: type) -> Struct:
        for prefix, owner, names in parts:
            types = owner.__annotations__
            cls.__annotations__.update({prefix + name: types[name] for name in names.split()})
        return wp.struct(cls)

    return decorate


def values_of(names: Iterable[str], *owners: Owner) -> dict[str, Field]:
    """Return the value of each name in the first owner that has it; worlds have `contact_...` and `efc_...`, too."""
    fields: list[Any] = []
    for owner in owners:
        fields.append(owner if isinstance(owner, Mapping) else vars(owner))
        if isinstance(owner, mjw.Data):
            for prefix, part in (("contact_", owner.contact), ("efc_", owner.efc)):
                fields.append({prefix + name: array for name, array in vars(part).items()})
    owned = ChainMap(*fields)
    return {name: owned[name] for name in names}


def filled(struct: Struct, *owners: Owner) -> Any:
    """Return a struct whose fields have the values of their names in the first owner that has them; see `values_of`."""
    instance = struct()
    for name, value in values_of(struct.vars, *owners).items():
        setattr(instance, name, value)
    return instance
