"""Terms keep their constants here as device tensors, made once: a step must not upload any."""

import re
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.device.constants import as_constant
from ksim_rl.scene.names import Index, as_index


def constant(values: Sequence[float], device: torch.device) -> Float[Tensor, " L"]:
    """Return `values` as a float32 tensor on the device; the same tensor for the same values, for ever."""
    return _constant(tuple(values), device)


@cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    # Made outside of inference mode: the tensor outlives the mode of the call that happens to come first.
    with torch.inference_mode(False):
        return as_constant(torch.tensor(values, dtype=torch.float32, device=device))


def array_constant(values: np.ndarray, device: torch.device) -> Float[Tensor, "*shape"]:
    """Return an array, such as a model's own values, as a float32 tensor; the same for the same values, for ever."""
    # A flat tuple is the key of the cache; the view gives the shape back.
    return constant(values.ravel().tolist(), device).view(values.shape)


def index_constant(ids: Sequence[int], device: torch.device) -> Int[Tensor, " N"] | slice:
    """Return `ids` as an index on the device, a slice if they are contiguous; the same for the same ids, for ever."""
    return _index_constant(tuple(ids), device)


@cache
def _index_constant(ids: tuple[int, ...], device: torch.device) -> Index:
    with torch.inference_mode(False):
        index = as_index(ids, device)
    if isinstance(index, Tensor):
        return as_constant(index)
    return index


def values_by_name(
    field: str, table: Mapping[str, float], names: Sequence[str]
) -> tuple[float, ...]:
    """Spread a table of patterns (regular expressions, full match) over names, which must match one each."""
    return _values_by_name(field, tuple(table.items()), tuple(names))


@cache
def _values_by_name(
    field: str, table: tuple[tuple[str, float], ...], names: tuple[str, ...]
) -> tuple[float, ...]:
    for pattern, _ in table:
        # A pattern without a match is most likely a mistyped name.
        if not any(re.fullmatch(pattern, name) for name in names):
            raise ValueError(
                f"{field}: pattern {pattern!r} matches nothing: {near(pattern, names)}"
            )
    values = []
    for name in names:
        matches = [(pattern, value) for pattern, value in table if re.fullmatch(pattern, name)]
        # With two matches the value would depend on the order of the table.
        if len(matches) != 1:
            patterns = [pattern for pattern, _ in matches]
            raise ValueError(
                f"{field}: {name!r} matches {patterns or 'no pattern'}; give each name one value"
            )
        values.append(float(matches[0][1]))
    return tuple(values)
