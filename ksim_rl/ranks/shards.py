"""Gathers and deals out the checkpoint of several ranks: each tensor once, or once per rank where they differ.

The same number of ranks gets its own tensors back, bit for bit. Another number shares the same envs, in the order of
all ranks' envs: going from 1 rank to 2 and back to 1 continues the same run.
"""

import zlib
from collections.abc import Mapping
from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.device.group import rank, size
from ksim_rl.device.state_tree import State, branch, number, tensors

Tensors = dict[str, Shaped[Tensor, "*?leaf"]]
# Below it, `ReplayRing` keeps rows in the order of places and, in each place, of envs.
_RING = "/replay/ring/"
# Counters of each rank, which metrics add up.
_COUNTERS = ("/inexact_count", "/non_finite_count", "/non_finite_env_states")
# The parts of `RunningMoments`: of the observations that a rank has seen itself.
_COUNT = "count"
_MEAN = "exact_mean"
_SQUARES = "exact_sum_of_squares"


def gathered(own: Mapping[str, Shaped[Tensor, "*?leaf"]]) -> dict[str, Any]:
    """Return, on rank 0, the number of ranks and the tensors of other ranks that differ from rank 0's.

    All ranks call it with tensors on the host, of the same names and shapes.
    """
    # The same order on all ranks.
    names = sorted(own)
    digests = []
    for name in names:
        raw = _bytes(own[name]).numpy().tobytes()
        digests.append(zlib.crc32(raw))
    digests_N = torch.tensor(digests, dtype=torch.int64)
    parts = [torch.empty_like(digests_N) for _ in range(size())]
    dist.all_gather(parts, digests_N)
    # Only digests travel so far; equal tensors, such as the networks, never do.
    differs_N = torch.stack(parts).ne(parts[0]).any(0).tolist()
    differing = [name for name, differs in zip(names, differs_N, strict=True) if differs]
    found: dict[str, Any] = {"size": size(), "parts": {}}
    if not differing:
        return found
    # As bytes, so that one collective carries all dtypes.
    flat = torch.cat([_bytes(own[name]) for name in differing])
    if rank() == 0:
        flats = [torch.empty_like(flat) for _ in range(size())]
    else:
        flats = None
    dist.gather(flat, flats, dst=0)
    # Rank 0's own are in the checkpoint anyway.
    for index, other in enumerate(flats or ()):
        if index:
            pieces = other.split([_bytes(own[name]).numel() for name in differing])
            found["parts"][str(index)] = {
                name: piece.clone().view(own[name].dtype).reshape(own[name].shape)
                for name, piece in zip(differing, pieces, strict=True)
            }
    return found


def dealt(
    first: Mapping[str, Shaped[Tensor, "*?leaf"]],
    saved: State | None,
    live: Mapping[str, Shaped[Tensor, "*?leaf"]],
) -> Tensors:
    """Return this rank's tensors of a checkpoint: rank 0's, changed by the result of `gathered`; None is of one rank.

    `live` are those that this run has now, and whose shapes tell where the envs are. A ValueError says how many envs
    fit.
    """
    parts = [dict(first)]
    if saved is not None:
        differing = branch(saved, "parts")
        for index in range(1, int(number(saved, "size"))):
            # A rank whose tensors all equal rank 0's has no entry.
            own = tensors(branch(differing, str(index))) if str(index) in differing else {}
            parts.append({**first, **own})
    before = len(parts)
    # The same number of ranks: no tensor is cut or merged.
    if before == size():
        return parts[rank()]
    return {name: _dealt_one(name, parts, live.get(name)) for name in first}


def share_of(part: Any, field: str, ranks_before: int) -> int:
    """Return a config's `field`, which is per rank, such that all ranks have as many as `ranks_before` had.

    A ValueError says where that is no whole number.
    """
    number = getattr(part, field)
    if number * ranks_before % size():
        raise ValueError(
            f"{field}={number} on each of {ranks_before} ranks cannot be shared equally by {size()}: resume the run on "
            f"{ranks_before}"
        )
    return number * ranks_before // size()


def _dealt_one(name: str, parts: list[Tensors], live: Tensor | None) -> Tensor:
    tensors = [part[name] for part in parts]
    # Added up later by metrics, so one rank has the total and the others have nothing.
    if name.endswith(_COUNTERS):
        total = torch.stack(tensors).sum(0)
        if rank():
            return torch.zeros_like(total)
        return total
    # A replay keeps [places * E, ...]: envs are joined and cut within each place.
    update, found, leaf = name.partition(_RING)
    if found and leaf.startswith(("available", "depth", "content/")):
        num_envs = len(parts[0][f"{update}{_RING}head"])
        rings_PE = torch.cat([rows.unflatten(0, (-1, num_envs)) for rows in tensors], 1)
        return rings_PE.chunk(size(), 1)[rank()].flatten(0, 1)
    shape = tensors[0].shape
    # The dim in which the sizes differ is the dim of the envs.
    if live is not None and live.shape != shape:
        dims = range(min(live.ndim, len(shape)))
        dim = next((dim for dim in dims if live.shape[dim] != shape[dim]), len(shape))
        if live.ndim != len(shape) or shape[dim] * len(parts) != live.shape[dim] * size():
            raise ValueError(
                f"{name} is {list(shape)} in the checkpoint of {len(parts)} ranks and {list(live.shape)} in this run "
                f"of {size()}: all ranks together must have as many envs as before"
            )
        width = live.shape[dim]
        whole = torch.cat(tensors, dim)
        return whole.narrow(dim, rank() * width, width).clone()
    # Running moments are merged, as each rank has counted other rows.
    room, _, leaf = name.rpartition("/")
    stem = leaf.rpartition(".")[0]
    prefix = f"{room}/{stem}." if stem else f"{room}/"
    if all(f"{prefix}{part}" in parts[0] for part in (_COUNT, _MEAN, _SQUARES)):
        return _merged_moments(prefix, parts)[name.removeprefix(prefix)]
    return tensors[0]


def _merged_moments(prefix: str, parts: list[Tensors]) -> Tensors:
    """Give rank 0 the counts of all ranks, and the others nothing; `mean` and `var` are of all ranks already."""
    merged = {
        leaf.removeprefix(prefix): tensor
        for leaf, tensor in parts[0].items()
        if leaf.startswith(prefix)
    }
    if rank():
        zeros = {name: torch.zeros_like(merged[name]) for name in (_COUNT, _MEAN, _SQUARES)}
        return merged | zeros
    for part in parts[1:]:
        count = merged[_COUNT].double()
        added = part[f"{prefix}{_COUNT}"].double()
        share = added / (count + added).clamp_min(1)
        delta = part[f"{prefix}{_MEAN}"] - merged[_MEAN]
        merged[_SQUARES] = (
            merged[_SQUARES] + part[f"{prefix}{_SQUARES}"] + delta.square() * share * count
        )
        merged[_MEAN] = merged[_MEAN] + delta * share
        merged[_COUNT] = merged[_COUNT] + part[f"{prefix}{_COUNT}"]
    return merged


def _bytes(tensor: Tensor) -> Tensor:
    return tensor.contiguous().reshape(-1).view(torch.uint8)
