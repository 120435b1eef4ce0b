"""Splits nested state into flat, plain parts: tensors by path, and JSON values by path.

A path joins the keys with `/`; a key's own `~` and `/` are written `~0` and `~1` (JSON Pointer, RFC 6901).
"""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import torch
from jaxtyping import Shaped
from torch import Tensor
from torch.utils._pytree import PyTree

Value: TypeAlias = (
    Mapping[str, "Value"]
    | Sequence["Value"]
    | Shaped[Tensor, "*?leaf"]
    | str
    | int
    | float
    | bool
    | None
)
State: TypeAlias = Mapping[str, Value]
"""What a part of a run needs to go on: nested, with tensors and plain values as leaves."""


DESCRIPTION = "_extra_state"
"""How names end under which torch modules describe themselves in a state, such as the pictures of an encoder."""


def branch(state: State, name: str) -> State:
    """Return a nested state; a ValueError where a leaf has its name."""
    found = state[name]
    if not isinstance(found, Mapping):
        raise _other_kind(name, found, "a mapping")
    return found


def tensor(state: State, name: str) -> Shaped[Tensor, "*leaf"]:
    """Return a tensor of a state; a ValueError where something else has its name."""
    found = state[name]
    if not isinstance(found, Tensor):
        raise _other_kind(name, found, "a tensor")
    return found


def number(state: State, name: str) -> float:
    """Return a number of a state; a ValueError where something else has its name."""
    found = state[name]
    if isinstance(found, bool) or not isinstance(found, (int, float)):
        raise _other_kind(name, found, "a number")
    return found


def text(state: State, name: str) -> str:
    """Return a text of a state; a ValueError where something else has its name."""
    found = state[name]
    if not isinstance(found, str):
        raise _other_kind(name, found, "a text")
    return found


def tensors(state: State) -> dict[str, Shaped[Tensor, "*?leaf"]]:
    """Return a state that has nothing but tensors; a ValueError names another entry."""
    return {name: tensor(state, name) for name in state}


def _other_kind(name: str, found: Value, expected: str) -> ValueError:
    return ValueError(f"the state's {name!r} is {_describe(found)}: expected {expected}")


def split(state: State) -> tuple[dict[str, Shaped[Tensor, "*?leaf"]], dict[str, Value]]:
    """Separate nested state into tensors (detached copies on the host) and JSON values, each by path."""
    tensors: dict[str, Tensor] = {}
    values: dict[str, Value] = {}

    def visit(path: str, node: PyTree) -> None:
        # Keys may contain the separator.
        if isinstance(node, Mapping) and node:
            for key, child in node.items():
                escaped = str(key).replace("~", "~0").replace("/", "~1")
                visit(f"{path}/{escaped}", child)
        # An empty mapping has no leaf, and would be lost.
        elif isinstance(node, Mapping):
            values[path] = {}
        elif isinstance(node, Tensor):
            tensors[path] = node.detach().to("cpu", copy=True).contiguous()
        # JSON knows no tuples.
        elif _is_plain(node):
            values[path] = list(node) if isinstance(node, tuple) else node
        else:
            raise ValueError(
                f"state {path} is a {type(node).__name__}: a checkpoint holds tensors and plain data "
                "(None, bool, int, float, str, lists of those) only"
            )

    visit("", state)
    return tensors, values


def join(tensors: Mapping[str, Shaped[Tensor, "*?leaf"]], values: Mapping[str, Value]) -> State:
    """Undo `split`."""
    # A state that is itself empty has the empty path.
    if list(values) == [""] and not tensors:
        return {}
    state: dict[str, Value] = {}
    for path, leaf in [*tensors.items(), *values.items()]:
        keys = path.split("/")[1:]
        *parents, last = [key.replace("~1", "/").replace("~0", "~") for key in keys]
        node = state
        for key in parents:
            # Parents are made on the way; one that is a leaf already is a fault of the file.
            node = node.setdefault(key, {})
            if not isinstance(node, dict):
                raise ValueError(f"state {path} lies below a leaf")
        node[last] = leaf
    return state


def copy_into(live: Mapping[str, Shaped[Tensor, "*?leaf"]], saved: State, *, what: str) -> None:
    """Copy saved tensors into live ones, whose addresses stay for captured graphs; a ValueError names the misfit.

    What describes a module has to be equal. States of before there was such a description have none, and are taken.
    """
    # Names are compared in both directions, then shapes, before anything is written.
    described = [name for name in live if name.endswith(DESCRIPTION)]
    for name in described:
        _check_description(live[name], saved.get(name), what=f"{what}: {name!r}")
    # No memory of a module: it would be written for nothing.
    live = {name: tensor for name, tensor in live.items() if name not in described}
    saved = {name: value for name, value in saved.items() if name not in described}
    for name in live:
        if name not in saved:
            raise ValueError(f"{what}: the checkpoint has no {name!r}")
    for name in saved:
        if name not in live:
            raise ValueError(f"{what}: the checkpoint's {name!r} is unknown to this run")
    for name, tensor in live.items():  # in the order of the layers, which a file does not keep
        have = _describe(saved[name])
        want = _describe(tensor)
        # The zoo keeps matrices as float16, and each of these numbers is one of float32.
        if have not in (want, want.replace("float32", "float16")):
            raise ValueError(f"{what}: {name!r} is {have} in the checkpoint and {want} in this run")
    # Parameters that require gradients refuse to be written otherwise.
    with torch.no_grad():
        for name, tensor in live.items():
            copy = saved[name]
            # Or else it would have been described in another way.
            assert isinstance(copy, Tensor)
            tensor.copy_(copy)


def _check_description(live: Tensor, saved: Value, *, what: str) -> None:
    if saved is None:
        return
    have = saved.tolist() if isinstance(saved, Tensor) else saved
    want = live.tolist()
    if have != want:
        raise ValueError(f"{what} is {have} in the checkpoint and {want} in this run")


def _describe(value: PyTree) -> str:
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
    return type(value).__name__


def _is_plain(node: PyTree) -> bool:
    if isinstance(node, (list, tuple)):
        return all(_is_plain(item) for item in node)
    return node is None or isinstance(node, (bool, int, float, str))
