"""Describes by plain values the state of objects that change in place: generators, iterators, arrays."""

import random
import warnings
import zlib
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import PurePath

import numpy as np
import torch
from torch.utils._pytree import PyTree

PLAIN = (
    type(None),
    bool,
    int,
    float,
    complex,
    str,
    bytes,
    range,
    slice,
    Enum,
    PurePath,
    np.generic,
    torch.device,
    torch.dtype,
)
"""Types whose objects never change, so that an equal one is as good."""


def state_of(source: random.Random | np.random.Generator | np.random.RandomState) -> int:
    """Return a number that identifies the state of a random generator of Python or NumPy."""
    if isinstance(source, random.Random):
        return hash(source.getstate())
    if isinstance(source, np.random.Generator):
        # States of NumPy are nested dicts with arrays, which have no hash.
        return hash(_hashable(source.bit_generator.state))
    return hash(_hashable(source.get_state(legacy=False)))


def _hashable(tree: PyTree) -> PyTree:
    """Return a tree of plain values in which checksums stand for arrays."""
    if isinstance(tree, np.ndarray):
        return checksum(tree)
    if isinstance(tree, Mapping):
        return tuple((key, _hashable(value)) for key, value in tree.items())
    return tree


def checksum(array: np.ndarray) -> int:
    """Return a number that changes with the content of an array."""
    return zlib.crc32(array.tobytes())


def place_of(iterator: Iterator) -> str | None:
    """Return the position of one of Python's own iterators, or None where it does not tell."""
    # Copying iterators of itertools is deprecated since Python 3.12.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            _, *arguments = iterator.__reduce__()
        except (TypeError, AttributeError):
            return None
    # The object that it iterates over may be large, and is watched elsewhere if it can change.
    # `__reduce__` gives the iterated object and the position; only plain ones can be compared.
    plain = [argument for argument in arguments if issubclass(type(argument), PLAIN)]
    # Chains and zips hold other iterators, which have places, too.
    nested = [item for part in arguments if isinstance(part, tuple) for item in part]
    within = [place_of(item) for item in nested if isinstance(item, Iterator)]
    return repr((plain, [item for item in nested if issubclass(type(item), PLAIN)], within))
