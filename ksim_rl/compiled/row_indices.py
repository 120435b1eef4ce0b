"""Writes operations that pick elements by an index as C++."""

from collections.abc import Sequence

import torch
from jaxtyping import Shaped
from torch import Tensor
from torch.utils._pytree import PyTree

from ksim_rl.compiled.cells import Cells, NotARowError, names_of
from ksim_rl.device.recording import OpArgs, OpKwargs


def _one_index(indices: Sequence[PyTree]) -> int:
    """Return the dim that is indexed; only one may be, by numbers."""
    places = [k for k, index in enumerate(indices) if index is not None]
    if len(places) != 1 or indices[places[0]].dtype != torch.int64:
        raise NotARowError("several indices, or a mask")
    return places[0]


def _picked(index: Tensor, names: Sequence[str], size: int, cells: Cells) -> str:
    cell = cells.at(index, names)
    return f"({cell} < 0 ? {cell} + {size} : {cell})"


def write_index(args: OpArgs, kwargs: OpKwargs, out: Shaped[Tensor, "*out"], cells: Cells) -> None:
    """Write the elements that one index of whole numbers picks along a dim, or along the rows of a shared table."""
    source, indices = args[:2]
    dim = _one_index(indices)
    index = indices[dim]
    first = int(bool(cells.rows))
    shape = cells.inner(out)
    names = names_of(len(shape))
    at = dim - first
    if dim < first:  # each row picks from a table that all have
        picked = _picked(index, names[: index.ndim - 1], source.shape[0], cells)
        place = [picked, *names[index.ndim - 1 :]]
        cells.loop(shape, [f"{cells.at(out, names)} = {cells.uniform.at(source, place)};"])
        return
    picked = _picked(index, names[at : at + index.ndim], source.shape[dim], cells.uniform)
    place = [*names[:at], picked, *names[at + index.ndim :]]
    cells.loop(shape, [f"{cells.at(out, names)} = {cells.at(source, place)};"])


def write_index_select(
    args: OpArgs, kwargs: OpKwargs, out: Shaped[Tensor, "*out"], cells: Cells
) -> None:
    """Write the slices that an index picks along a dim."""
    source, dim, index = args
    write_index((source, [*[None] * (dim % source.ndim), index]), kwargs, out, cells)


def write_index_put(
    args: OpArgs, kwargs: OpKwargs, out: Shaped[Tensor, "*out"], cells: Cells
) -> None:
    """Write values to the places that an index picks along a dim; the rows must not be written so."""
    target, indices, values = args[:3]
    if len(args) > 3 and args[3]:
        raise NotARowError("index_put that adds")
    dim = _one_index(indices)
    index = indices[dim]
    first = int(bool(cells.rows))
    if dim < first or target is not out:
        raise NotARowError("rows are written")
    at = dim - first
    shape = [*out.shape[first:dim], *index.shape, *out.shape[dim + 1 :]]
    names = names_of(len(shape))
    picked = _picked(index, names[at : at + index.ndim], out.shape[dim], cells.uniform)
    place = [*names[:at], picked, *names[at + index.ndim :]]
    cells.loop(shape, [f"{cells.at(out, place)} = {cells.at(values, names)};"])


def write_gather(args: OpArgs, kwargs: OpKwargs, out: Shaped[Tensor, "*out"], cells: Cells) -> None:
    """Write, at each place, the element that the index there picks along a dim."""
    source, dim, index = args[:3]
    dim = dim % source.ndim
    first = int(bool(cells.rows))
    if dim < first:
        raise NotARowError("rows are gathered")
    names = names_of(out.ndim - first)
    place = [*names]
    place[dim - first] = f"(int){cells.at(index, names)}"  # gather takes no negative numbers
    cells.loop(cells.inner(out), [f"{cells.at(out, names)} = {cells.at(source, place)};"])
