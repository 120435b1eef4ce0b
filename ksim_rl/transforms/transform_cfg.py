"""Describes a transform as data, so that a config can name it and each env can build its own."""

import dataclasses
import functools
import inspect
import operator
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self

from tensordict import NestedKey
from torchrl.envs.transforms import Transform

from ksim_rl.checked import Annotation
from ksim_rl.checks import naming, near
from ksim_rl.config import class_paths
from ksim_rl.config.class_paths import TARGET
from ksim_rl.config.config_tree import OwnTree, build_value, to_tree
from ksim_rl.config.trees import Plain, Tree
from ksim_rl.transforms import stock

_PLAIN = (bool, int, float, str, types.NoneType)
_NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


class TransformCfg(OwnTree):
    """A class of transforms with the arguments to build it by, which are data.

    In a config it is a node with `_target_`, the path of the class (one of ours, of a plug-in, or of TorchRL's that are
    data, see `ksim_rl.transforms.stock`), and the arguments by the names of its signature.

    Example:
        >>> lag = TransformCfg(ActionDelay, delay=DelayCfg(min_lag=1, max_lag=2))
    """

    def __init__(self, transform: type[Transform], /, **arguments: Any) -> None:
        if not (isinstance(transform, type) and issubclass(transform, Transform)):
            raise ValueError(
                f"{transform!r}: expected a class of transforms, with its arguments beside it"
            )
        stock.check(transform)
        parameters = _parameters(transform)
        # An unknown name is refused with the near ones.
        for name in arguments:
            _annotation(transform, name, name)
        missing = [
            name for name, (_, default) in parameters.items()
            if default is inspect.Parameter.empty and name not in arguments
        ]  # fmt: skip
        if missing:
            raise ValueError(f"{transform.__name__} needs the argument {missing[0]!r}")
        for name, value in arguments.items():
            _check_data(name, value)
        self.transform = transform
        # Defaults included, so that a saved config does not change with the defaults of a later version.
        self.arguments = {
            name: _listed(arguments.get(name, default), annotation)
            for name, (annotation, default) in parameters.items()
        }
        # Built once to try: a refusal of the class shows before anything compiles.
        self.build()

    def build(self, name: str | None = None) -> Transform:
        """Return a new transform; with a name it draws from a stream of that name, unless its arguments give one."""
        arguments = self.arguments
        # Named streams: two transforms of one class with the same keys draw differently.
        if name is not None and "stream" in arguments and arguments["stream"] is None:
            arguments = {**arguments, "stream": f"transforms.{name}"}
        with naming(self.transform.__name__, TypeError, KeyError, RuntimeError, ImportError):
            return self.transform(**arguments)

    def to_tree(self) -> Tree:
        """Return the plain tree: the path of the class, and all arguments."""
        parameters = _parameters(self.transform)
        arguments = {
            name: to_tree(value, parameters[name][0]) for name, value in self.arguments.items()
        }
        return {TARGET: class_paths.public_path(self.transform), **arguments}

    @classmethod
    def from_tree(cls, tree: Plain, path: str) -> Self:
        """Build the description of a node; a ValueError names the full path of the fault."""
        if isinstance(tree, cls):
            return tree
        # Without a class there is nothing to check the arguments by.
        if not isinstance(tree, Mapping) or TARGET not in tree:
            raise ValueError(
                f"{path}: needs {TARGET}, the class of this transform, and its arguments"
            )
        transform = class_paths.find(
            tree[TARGET],
            path,
            kind="transform",
            accepts=_is_transform,
            besides=frozenset({stock.PACKAGE}),
        )
        with naming(f"{path}.{TARGET}"):
            stock.check(transform)
        arguments = {}
        # Arguments are built by the annotations of the class, so that nested configs become their classes.
        for name, value in tree.items():
            if name != TARGET:
                where = f"{path}.{name}"
                arguments[name] = build_value(_annotation(transform, name, where), value, where)
        with naming(path):
            return cls(transform, **arguments)

    def given(self) -> dict[str, Any]:
        """Return the arguments that differ from their defaults."""
        parameters = _parameters(self.transform)
        return {
            name: value for name, value in self.arguments.items() if value != parameters[name][1]
        }

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TransformCfg):
            return NotImplemented
        # As trees, in which keys are lists whether they were tuples or not.
        return self.to_tree() == other.to_tree()

    def __repr__(self) -> str:
        shown = ", ".join(f"{name}={value!r}" for name, value in self.given().items())
        return f"{self.transform.__name__}({shown})"


def _is_transform(value: type) -> bool:
    return isinstance(value, type) and issubclass(value, Transform)


@functools.cache
def _parameters(transform: type[Transform]) -> dict[str, tuple[Annotation, Any]]:
    """Return annotation and default of each argument that can be given by name."""
    # Not the class's signature, which for some of TorchRL's classes comes from `__new__`.
    _self, *parameters = inspect.signature(transform.__init__).parameters.values()
    try:
        hints = typing.get_type_hints(transform.__init__)
    except (NameError, TypeError):  # names that only type checkers import
        hints = {}
    return {
        parameter.name: (_as_data(hints.get(parameter.name, Any)), parameter.default)
        for parameter in parameters
        if parameter.kind in _NAMED
    }


def _annotation(transform: type[Transform], name: str, where: str) -> Annotation:
    parameters = _parameters(transform)
    if name not in parameters:
        raise ValueError(
            f"unknown field {where!r} of {transform.__name__}: {near(str(name), parameters)}"
        )
    return parameters[name][0]


def _as_data(annotation: Annotation) -> Annotation:
    """Return the part of an annotation that a config can give: no tensors, functions and the like; else `Any`."""
    # Both spellings of a union, `Union[A, B]` and `A | B`.
    is_union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    options = [
        option
        for option in (typing.get_args(annotation) if is_union else (annotation,))
        if _is_data(option)
    ]
    if options:
        return functools.reduce(operator.or_, options)
    return Any


def _listed(value: Any, annotation: Annotation) -> Any:
    """Return a nested key, which is a tuple, as a list of that one where several keys may stand."""
    options = typing.get_args(annotation)
    takes_keys = any(
        typing.get_origin(option) in (Sequence, list) and NestedKey in typing.get_args(option)
        for option in options
    )
    # A tuple is one nested key, and must not be read as a list of several.
    if takes_keys and isinstance(value, tuple):
        return [value]
    return value


def _is_data(option: Annotation) -> bool:
    origin = typing.get_origin(option)
    if origin in (tuple, list, Sequence, Mapping, dict):
        return all(_is_data(entry) or entry is Ellipsis for entry in typing.get_args(option))
    if origin in (typing.Union, types.UnionType):
        return all(map(_is_data, typing.get_args(option)))
    return (
        origin is Literal
        or option in _PLAIN
        or option is NestedKey
        or dataclasses.is_dataclass(option)
    )


def _check_data(name: str, value: Any) -> None:
    """Refuse values that a config file could not hold."""
    if isinstance(value, Mapping):
        for key, entry in value.items():
            if not isinstance(key, str):
                raise ValueError(
                    f"{name}: key {key!r}: the keys of a mapping are strings in a config"
                )
            _check_data(f"{name}.{key}", entry)
    elif isinstance(value, (list, tuple)):
        for index, entry in enumerate(value):
            _check_data(f"{name}[{index}]", entry)
    elif not isinstance(value, _PLAIN) and (
        isinstance(value, type) or not dataclasses.is_dataclass(value)
    ):
        raise ValueError(f"{name}={value!r}: expected data, which a config can hold")
