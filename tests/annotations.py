"""Checks one value against one annotation with axes, and binds the axes that it finds."""

import inspect
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import AbstractArray

Check = Callable[[Any, dict[str, Any]], str]
"""Says in what way a value is not as annotated, given the sizes bound so far; empty where it is."""


def names_a_shape(annotation: object) -> bool:
    """Say whether axes stand anywhere in `annotation`."""
    if inspect.isclass(annotation) and issubclass(annotation, AbstractArray):
        return True
    parts = annotation if isinstance(annotation, list | tuple) else typing.get_args(annotation)
    return any(names_a_shape(part) for part in parts)


def _has_dtype(annotation: type[AbstractArray], dtype: object) -> bool:
    kind: Any = annotation.dtype
    if isinstance(dtype, torch.dtype):
        return isinstance(torch.empty((), dtype=dtype), kind[torch.Tensor, ""])
    return isinstance(np.empty((), dtype=dtype), kind[np.ndarray, ""])


def _axis_error(axis: str, size: int, sizes: dict[str, Any]) -> bool:
    """Bind one axis in `sizes`, or say that it has another size there."""
    if axis.startswith("#"):
        if size == 1:
            return False
        axis = axis[1:]
    if axis == "_" or axis.startswith("?"):  # ?L: another size in each item of a container
        return False
    if axis.isidentifier():
        return sizes.setdefault(axis, size) != size
    return eval(axis, {}, sizes) != size  # noqa: S307  # a size such as 3 or T+1, from our own source


def _array_check(annotation: type[AbstractArray]) -> Check:
    axes = annotation.dim_str.split()
    kind = annotation.array_type
    (several, *more) = [
        index for index, axis in enumerate(axes) if "*" in axis[:2] or axis == "..."
    ] or [-1]
    assert not more, annotation
    count = len(axes)
    fixed = [(index, int(axis)) for index, axis in enumerate(axes) if axis.isdecimal()]
    named = [
        (index, axis) for index, axis in enumerate(axes) if axis.isidentifier() and axis != "_"
    ]
    plain = several < 0 and len(fixed) + len(named) == count

    fits: dict[object, bool] = {}

    def check(value: Any, sizes: dict[str, Any]) -> str:
        if value.__class__ is not kind and not isinstance(value, kind):
            return f"is of type {type(value).__name__}"
        shape, dtype = value.shape, value.dtype
        if dtype not in fits:
            fits[dtype] = _has_dtype(annotation, dtype)
        if not fits[dtype]:
            return f"has dtype {dtype}"
        if plain:
            right = len(shape) == count
            for index, size in fixed:
                right = right and shape[index] == size
            for index, axis in named:
                right = right and sizes.setdefault(axis, size := shape[index]) == size
            return "" if right else f"has shape {tuple(shape)}"
        names = axes
        if several >= 0:
            if len(shape) < count - 1:
                return f"has shape {tuple(shape)}"
            width = len(shape) - count + 1
            inner = tuple(shape[several : several + width])
            if (
                axes[several][0] == "*"
                and "?" not in axes[several]
                and sizes.setdefault(axes[several], inner) != inner
            ):
                return f"has shape {tuple(shape)}"
            names = [*axes[:several], *["_"] * width, *axes[several + 1 :]]
        if len(shape) != len(names) or any(
            _axis_error(a, n, sizes) for a, n in zip(names, shape, strict=True)
        ):
            return f"has shape {tuple(shape)}"
        return ""

    return check


def _union_check(parts: Iterable[object]) -> Check:
    checks = [check_of(part) for part in parts]

    def check(value: Any, sizes: dict[str, Any]) -> str:
        errors = []
        for alternative in checks:
            before = dict(sizes)
            if not (error := alternative(value, sizes)):
                return ""
            sizes.clear()
            sizes.update(before)
            errors.append(error)
        return errors[0]

    return check


def _kind_check(kind: type) -> Check:
    # An int will do for a float, as type checkers have it.
    kinds = (int, float) if kind is float else kind
    return lambda value, sizes: (
        "" if isinstance(value, kinds) else f"is of type {type(value).__name__}"
    )


def items_check(kind: type, items: Callable[[Any], Iterable[Any]], item: Check) -> Check:
    """Return a check of a container of class `kind` and of each of its `items`."""

    def check(value: Any, sizes: dict[str, Any]) -> str:
        if not isinstance(value, kind):
            return f"is of type {type(value).__name__}"
        for index, part in enumerate(items(value)):
            if error := item(part, sizes):
                return f"has an item {index} that {error}"
        return ""

    return check


def _tuple_check(parts: tuple[object, ...]) -> Check:
    checks = [check_of(part) for part in parts]

    def check(value: Any, sizes: dict[str, Any]) -> str:
        if not isinstance(value, tuple) or len(value) != len(checks):
            return f"is no tuple of {len(checks)}"
        for index, (part, of_part) in enumerate(zip(value, checks, strict=True)):
            if error := of_part(part, sizes):
                return f"has an item {index} that {error}"
        return ""

    return check


def check_of(annotation: Any) -> Check:
    """Return a function of a value and of the axes bound so far, which says in what way the value is not as annotated.

    What has no axes is checked by its class at most: static types are pyright's.
    """
    if inspect.isclass(annotation) and issubclass(annotation, AbstractArray):
        return _array_check(annotation)
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return check_of(parts[0])
    if origin in (typing.Union, types.UnionType):
        return _union_check(parts)
    if not inspect.isclass(origin or annotation):
        return lambda value, sizes: ""
    kind = origin or annotation
    if kind is Any or (isinstance(kind, type(typing.Protocol)) and not names_a_shape(annotation)):
        return lambda value, sizes: ""
    if names_a_shape(annotation):
        if kind is tuple:
            if parts[-1] is Ellipsis:
                return items_check(tuple, iter, check_of(parts[0]))
            return _tuple_check(parts)
        if issubclass(kind, Mapping):
            return items_check(kind, lambda value: value.values(), check_of(parts[1]))
        if kind is not type and issubclass(kind, Iterable) and hasattr(kind, "__len__"):
            return items_check(kind, iter, check_of(parts[0]))
    return _kind_check(kind)
