"""Turns dataclasses into plain trees, which YAML and Hydra see, and builds them from checked trees.

A tree is made of dicts, lists and scalars. A dataclass becomes a dict of its fields; where the annotation does not say
which class it is (any term, any robot), the key `_target_` does. Only classes of allowed packages are ever imported
or built, so that a config file cannot run code.
"""

import collections.abc
import dataclasses
import functools
import operator
import types
import typing
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self, TypeVar, Union

from tensordict import NestedKey

from ksim_rl.checked import Annotation
from ksim_rl.checks import check_choice, near
from ksim_rl.config import class_paths
from ksim_rl.config.class_paths import TARGET
from ksim_rl.config.trees import Plain, Tree

Config = TypeVar("Config")


class OwnTree(ABC):
    """Base of configs that are no dataclasses, and write and read their own trees."""

    @abstractmethod
    def to_tree(self) -> Tree:
        """Return the plain tree, with its `_target_`."""

    @classmethod
    @abstractmethod
    def from_tree(cls, tree: Plain, path: str) -> Self:
        """Build the config that stands at `path`; a ValueError names the full path of a wrong entry."""


def to_tree(value: Any, annotation: Annotation = None) -> Any:
    """Return the plain tree of a dataclass, mapping, sequence or scalar."""
    if isinstance(value, OwnTree):
        return value.to_tree()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        # Resolved, since annotations may be texts.
        hints = typing.get_type_hints(type(value))
        tree: Tree = {}
        # The class is named only where the annotation does not say it: configs stay short.
        if type(value) is not _default_class(annotation):
            tree[TARGET] = class_paths.public_path(type(value))
        for field in dataclasses.fields(value):
            tree[field.name] = to_tree(getattr(value, field.name), hints[field.name])
        return tree
    if isinstance(value, Mapping):
        # Values of a mapping are of its second type.
        item = next(iter(typing.get_args(annotation)[1:]), None)
        return {str(key): to_tree(entry, item) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [to_tree(entry) for entry in value]
    return value


def default_tree(cls: type, annotation: Annotation = None) -> Tree:
    """Return the plain tree of a dataclass's defaults, with Hydra's "???" for fields that have none."""
    hints = typing.get_type_hints(cls)
    tree = {}
    # A group of Hydra has no annotation: its class is given by the group.
    if annotation is not None and cls is not _default_class(annotation):
        tree[TARGET] = class_paths.public_path(cls)
    # Defaults without building the class: it may have fields that must be given.
    for field in dataclasses.fields(cls):
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        missing = default is dataclasses.MISSING
        tree[field.name] = "???" if missing else to_tree(default, hints[field.name])
    return tree


def from_tree(annotation: type[Config], tree: Plain, path: str = "") -> Config:
    """Build the dataclass that a tree describes; `path` precedes the fields in errors, which name the valid values."""
    return build_value(annotation, tree, path)


def build_value(annotation: Annotation, value: Plain, path: str) -> Any:
    """Build the value that an annotation describes from a tree, as `from_tree` does; `Any` takes it as it is."""
    if annotation is Any:
        return value
    # The cases in order: null, trees that read themselves, dataclasses, then scalars and containers.
    alternatives = _alternatives(annotation)
    if value is None and type(None) in alternatives:
        return None
    alternatives = [option for option in alternatives if option is not type(None)]
    classes = [
        option for option in alternatives if isinstance(option, type) and option not in _SCALARS
    ]
    if len(classes) == 1 and issubclass(classes[0], OwnTree):
        return classes[0].from_tree(value, path)
    takes_mapping = any(typing.get_origin(option) in _MAPPINGS for option in alternatives)
    # A mapping is a dataclass if it says so, or if nothing else takes mappings.
    if isinstance(value, Mapping) and (
        TARGET in value or not takes_mapping and any(dataclasses.is_dataclass(c) for c in classes)
    ):
        return _build_dataclass(classes, value, path)
    for option in alternatives:
        built = _match(option, value, path)
        if built is not _NO_MATCH:
            return built
    # Literal values are listed with the near ones.
    if len(alternatives) == 1 and typing.get_origin(alternatives[0]) is Literal:
        check_choice(path, value, typing.get_args(alternatives[0]))
    raise ValueError(f"{path}={value!r}: expected {_describe(annotation)}")


# An object of its own, since None is a value.
_NO_MATCH = object()
_SCALARS = (bool, int, float, str, NestedKey)
_MAPPINGS = (collections.abc.Mapping, dict)


def _match(option: Annotation, value: Plain, path: str) -> Any:
    origin = typing.get_origin(option)
    arguments = typing.get_args(option)
    if origin is Literal:
        if value in arguments:
            return value
        return _NO_MATCH
    if origin in (tuple, collections.abc.Sequence, list):
        if not isinstance(value, (list, tuple)):
            return _NO_MATCH
        # YAML has no tuples: a list of keys and one nested key look alike.
        if arguments[0] == NestedKey and origin is not tuple:
            # A tuple is one nested key, so several keys are a list.
            return [_build_nested_key(entry, f"{path}[{i}]") for i, entry in enumerate(value)]
        # A fixed tuple has a type for each entry, the others one for all.
        kinds = arguments
        if origin is not tuple or arguments[1:] == (...,):
            kinds = arguments[:1] * len(value)
        if len(kinds) != len(value):
            return _NO_MATCH
        entries = enumerate(zip(kinds, value, strict=True))
        return tuple(build_value(kind, entry, f"{path}[{i}]") for i, (kind, entry) in entries)
    if origin in _MAPPINGS:
        if not isinstance(value, Mapping):
            return _NO_MATCH
        return {
            _build_key(arguments[0], k, path): build_value(arguments[1], entry, _join(path, k))
            for k, entry in value.items()
        }
    if option is NestedKey:
        return _build_nested_key(value, path)
    # bool is a subclass of int: `true` is no number, and 1 no truth value.
    if option not in (bool, str, int, float) or isinstance(value, bool) and option is not bool:
        return _NO_MATCH
    # YAML writes 1 for 1.0.
    if option is float:
        if isinstance(value, (int, float)):
            return float(value)
        return _NO_MATCH
    if isinstance(value, option):
        return value
    return _NO_MATCH


def _join(path: str, name: object) -> str:
    if path:
        return f"{path}.{name}"
    return str(name)


def _build_nested_key(value: Any, path: str) -> NestedKey:
    if isinstance(value, str):
        return value
    if isinstance(value, (list, tuple)) and value and all(isinstance(part, str) for part in value):
        return tuple(value)
    raise ValueError(f"{path}={value!r}: expected a key, or a list of the parts of a nested key")


def _build_key(annotation: Annotation, key: object, path: str) -> str | int:
    # YAML and Hydra give keys as text or as numbers.
    kinds = typing.get_args(annotation) or (annotation,)
    if int not in kinds:
        return str(key)
    try:
        return int(str(key))
    except ValueError:
        if str in kinds:
            return str(key)
        raise ValueError(f"{path}: key {key!r}: expected a whole number") from None


def _build_dataclass(classes: list[type], tree: Tree, path: str) -> Any:
    cls: type
    # A class of a package that may be built, and of the kind that the field asks for.
    if TARGET in tree:
        cls = class_paths.find(
            tree[TARGET], path, kind="dataclass", accepts=dataclasses.is_dataclass
        )
        # Protocols cannot be asked by `issubclass`.
        bases = [c for c in classes if not getattr(c, "_is_protocol", False)]
        if bases and not issubclass(cls, tuple(bases)):
            kinds = _describe(functools.reduce(operator.or_, bases))
            raise ValueError(f"{path}.{TARGET}={tree[TARGET]!r}: expected a kind of {kinds}")
    else:
        cls = next(option for option in classes if dataclasses.is_dataclass(option))
        if getattr(cls, "__abstractmethods__", None):
            raise ValueError(f"{path}: needs {TARGET}, the class of this {cls.__name__}")
    hints = typing.get_type_hints(cls)
    # Fields that the class computes itself are not given.
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    given = {}
    for key, entry in tree.items():
        # Configs of earlier versions stay readable.
        if key == TARGET or (cls.__name__, key) in class_paths.GONE:
            continue
        where = _join(path, key)
        if key not in fields:
            raise ValueError(f"unknown field {where!r} of {cls.__name__}: {near(str(key), fields)}")
        given[key] = build_value(hints[key], entry, where)
    # Told here, since the constructor would name the argument without its path.
    for name, field in fields.items():
        if name not in given and field.default is field.default_factory is dataclasses.MISSING:
            raise ValueError(
                f"{path}: {cls.__name__} needs the field {name!r}: {_describe(hints[name])}"
            )
    try:
        return cls(**given)
    except ValueError as error:
        # Its own checks name the field; the path is put in front.
        raise ValueError(_join(path, error)) from None


def _alternatives(annotation: Annotation) -> list[Annotation]:
    if typing.get_origin(annotation) in (Union, types.UnionType):
        return list(typing.get_args(annotation))
    return [annotation]


def _default_class(annotation: Annotation) -> Any:
    """Return the dataclass that a tree without `_target_` means: the first that the annotation names."""
    return next(
        (option for option in _alternatives(annotation) if dataclasses.is_dataclass(option)), None
    )


def _describe(annotation: Annotation) -> str:
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if origin in (Union, types.UnionType):
        return " or ".join(map(_describe, arguments))
    if origin in (tuple, list, collections.abc.Sequence):
        return f"a list of {', '.join(_describe(kind) for kind in arguments if kind is not ...)}"
    if origin in _MAPPINGS:
        return f"a mapping from {_describe(arguments[0])} to {_describe(arguments[1])}"
    if annotation in (None, types.NoneType):
        return "null"
    if isinstance(annotation, type):
        return annotation.__name__
    return str(annotation).replace("typing.", "").replace("collections.abc.", "")
