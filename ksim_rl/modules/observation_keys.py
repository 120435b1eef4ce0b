"""This module says what a network reads: one or several leaves of an EnvState, side by side."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.data import Composite

ObservationKey = str | tuple[str, ...]


def checked_keys(keys: Sequence[ObservationKey]) -> tuple[ObservationKey, ...]:
    """Return the keys as hashable ones.

    Raises:
        ValueError: if there is none, or one is no name or sequence of names, or one comes twice.
    """
    if isinstance(keys, str) or not keys:
        raise ValueError(f"in_keys={keys!r}: expected a list of one observation group or more")
    checked: list[ObservationKey] = []
    for index, key in enumerate(keys):
        names = (key,) if isinstance(key, str) else tuple(key)
        if not names or not all(isinstance(name, str) and name for name in names):
            raise ValueError(
                f"in_keys[{index}]={key!r}: expected a name, or a list of names for a nested key"
            )
        checked.append(names[0] if len(names) == 1 else names)
    if len(set(checked)) < len(checked):
        raise ValueError(f"in_keys={tuple(checked)!r}: each key can be read once")
    return tuple(checked)


def observation_dim(spec: Composite, keys: Sequence[ObservationKey]) -> int:
    """Return the size of the last dim of the observations at `keys`, side by side.

    Raises:
        ValueError: if the spec lacks a key.
    """
    there = list(spec.keys(True, True))
    for key in keys:
        if key not in there:
            raise ValueError(f"in_keys: the env has no observation {key!r}; it has {sorted(map(str, there))}")
    return sum(spec[key].shape[-1] for key in keys)


def side_by_side(observations: Sequence[Float[Tensor, "*batch ?L"]]) -> Float[Tensor, "*batch L"]:
    """Join observations along their last dim."""
    return observations[0] if len(observations) == 1 else torch.cat(tuple(observations), -1)
