"""Names the elements of tensors in C++ that runs once per row of a batch."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Shaped
from torch import Tensor

CTYPES = {
    torch.float32: "float",
    torch.float64: "double",
    torch.int64: "long long",
    torch.int32: "int",
    torch.uint8: "unsigned char",
    torch.bool: "bool",
}
"""The C++ type of an element by its torch dtype."""


class NotARowError(Exception):
    """An operation mixes rows, or is not known here: torch runs it."""


class Element(NamedTuple):
    """An element in use: its tensor, the distance between rows (0 where all use the same), its array, and its C++."""

    tensor: Tensor
    distance: int
    name: str
    text: str


class Loop(NamedTuple):
    """Statements for each place of a shape (without rows), in any order, and the elements that they use."""

    shape: tuple[int, ...]
    body: str
    elements: list[Element]


@dataclass(frozen=True)
class Cells:
    """Where tensors lie, for the operation at hand: `rows` are E, and 0 where it has no rows.

    `address` returns the name of an array, the place in it, and whether it has all rows. `loops` are the loops of the
    operation so far, and `seen` the elements in use since the last of them.
    """

    rows: int
    address: Callable[[Tensor], tuple[str, int, bool]]
    device: torch.device
    loops: list[Loop] = field(default_factory=list)
    seen: list[Element] = field(default_factory=list)

    @property
    def uniform(self) -> "Cells":
        """The same for tensors that have no rows."""
        return replace(self, rows=0)

    def inner(self, tensor: Shaped[Tensor, "*shape"]) -> list[int]:
        """Return the shape of a tensor without its rows."""
        if self.rows:
            return list(tensor.shape[1:])
        return list(tensor.shape)

    def at(self, tensor: Shaped[Tensor, "*shape"], place: Sequence[str]) -> str:
        """Return the element of a tensor at a place, whose indices are the operation's dims without the rows."""
        if tensor.dtype not in CTYPES:
            raise NotARowError(f"numbers of type {tensor.dtype}")
        if not tensor.numel():
            return "0"  # stands in sums over no elements, whose loops never run
        # A number of the host is a constant of the kernel, as it is of a CUDA graph.
        if tensor.device != self.device:
            return literal(tensor.item(), CTYPES[tensor.dtype])
        # The empty index stands for the row. Dims are aligned from the right, as torch broadcasts.
        indices = ([""] if self.rows else []) + list(place)
        if tensor.ndim:
            indices = indices[len(indices) - tensor.ndim :]
        else:
            indices = []
        name, offset, has_all_rows = self.address(tensor)
        terms = [str(offset)] if offset else []
        distance = 0
        for index, size, stride in zip(indices, tensor.shape, tensor.stride(), strict=True):
            # A broadcast dim: all places share one number.
            if size == 1 or stride == 0:
                continue
            if index:
                terms.append(f"{index} * {stride}" if stride != 1 else index)
            else:
                distance = stride
                # An array of a row's own holds one row, so the row does not count there.
                terms += [f"row * {stride}LL"] if has_all_rows else []
        text = f"{name}[{' + '.join(terms) or '0'}]"
        self.seen.append(Element(tensor, distance, name, text))
        return text

    def loop(self, shape: Sequence[int], body: Sequence[str]) -> None:
        """Write statements for each place of a shape, of indices `names_of(len(shape))`."""
        if 0 not in shape:
            # A shape with a zero has no places, so its loop is left out.
            self.loops.append(Loop(tuple(shape), " ".join(body), self.seen[:]))
        self.seen.clear()


def names_of(count: int) -> list[str]:
    """Return the names of so many indices."""
    return [f"i{k}" for k in range(count)]


def literal(value: float, ctype: str) -> str:
    """Return a number of Python in C++."""
    if ctype in ("float", "double"):
        value = float(value)
        # Python spells these numbers in ways that C++ does not know.
        if math.isnan(value):
            return "NAN"
        if math.isinf(value):
            return "INFINITY" if value > 0 else "(-INFINITY)"
        return f"({ctype}){value!r}"
    return f"({ctype}){int(value)}LL"
