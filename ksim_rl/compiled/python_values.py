"""Finds the Python values that objects depend on: attributes, containers, closures, and globals in their code.

Numbers in a tensor are no such value, as a recording reads them again each time; replacing the tensor is a change.
"""

import functools
import inspect
import operator
import random
import types
import weakref
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn

from ksim_rl.compiled.packages import OURS, is_library, package_of, packages_of
from ksim_rl.compiled.python_states import PLAIN, checksum, place_of, state_of

MOST_ITEMS = 10_000
"""Only the length of a larger container is watched."""
ABSENT = "(absent)"
_MODULE_PARTS = ("_modules", "_buffers", "_parameters")
# A reference to the root that the last step returned.
_CHANGES_BY_ITSELF = frozenset({"last_root"})
_ITERATORS = ("builtins", "itertools")

Values = Mapping[Any, Any]
# An object whose Python a step runs: a term, a transform, a network. All kinds are looked into, so that nothing is
# known of one beforehand.
Part: TypeAlias = object
Parts: TypeAlias = Mapping[str, Part]


@dataclass(frozen=True, eq=False)
class Listed:
    """Stands for the object `of` as a part that depends only on the values that `read` returns by name.

    With `reads_code` it also depends on the globals and closures that the code of these values reads.
    """

    of: Any
    read: Callable[[], Values]
    reads_code: bool = True


@dataclass(frozen=True, eq=False)
class Held:
    """Values in one place, which `read` returns by key; `spell` makes a name of a path and a key.

    `paths` say from which parts it is reached; `owner` is the object that has the values. If all of them are entries of
    one `table`, they are read faster: by `pick` from the table, or without `pick` all of its entries.
    """

    owner: Any
    read: Callable[[], Values]
    spell: Callable[[str, Hashable], str]
    paths: list[str]
    table: Values | None = None
    pick: Callable[[Values], tuple[Any, ...]] | None = None


def held_by(parts: Parts, device: torch.device) -> list[Held]:
    """Return all values that the parts depend on, each part by its name.

    A part is not entered from another one. Tensors that do not lie on `device`, where recordings read, are values.
    """
    search = _Search(parts, device)
    for name, part in parts.items():
        search.of_part(name, part)
    return list(search.found.values())


class _Search:
    """Goes from object to object; an object that several parts reach is found once, with a path from each."""

    def __init__(self, parts: Parts, device: torch.device) -> None:
        self.found: dict[tuple[int, str], Held] = {}
        self._device = device
        self._parts = set()
        for part in parts.values():
            if isinstance(part, Listed):
                owner = part.of
            else:
                owner = part
            self._parts.add(id(owner))
        self._packages = packages_of(parts.values())
        self._seen: set[int] = set()
        self._reads_code = True
        self._ahead: deque[tuple[Any, str]] = deque()
        # While the search lasts, no object may take the place of another one.
        self._alive: list[Any] = []

    def of_part(self, name: str, part: Part) -> None:
        # By part, so that a shared object gets a path from each part that reaches it.
        self._seen = set()
        self._reads_code = not isinstance(part, Listed) or part.reads_code
        self._look_at(part, name)
        while self._ahead:
            value, path = self._ahead.popleft()
            # Another part is listed on its own; plain values have nothing inside.
            is_other_part = id(value) in self._parts
            if is_other_part or issubclass(type(value), PLAIN) or id(value) in self._seen:
                continue
            self._seen.add(id(value))
            self._alive.append(value)
            self._look_at(value, path)

    def _look_at(self, value: Any, path: str) -> None:
        # The first kind that fits counts; an object of none of these is looked at as an instance of its class.
        looks: tuple[tuple[Any, Callable[[Any, str], None]], ...] = (
            (Listed, self._at_listed),
            (Tensor, self._at_tensor),
            (np.ndarray, self._at_array),
            ((dict, types.MappingProxyType), self._at_mapping),
            ((list, set, deque), self._at_items),
            ((tuple, frozenset), self._at_fixed_items),
            (types.FunctionType, self._at_function),
            (types.MethodType, self._at_method),
            ((types.BuiltinMethodType, types.MethodWrapperType), self._at_method_of_c),
            (functools.partial, self._at_partial),
            (property, self._at_property),
            ((staticmethod, classmethod), self._at_wrapper),
            (functools.cached_property, self._at_cached_property),
            (type, self._at_class),
            (types.ModuleType, self._at_module),
            (types.GeneratorType, self._at_generator),
            ((random.Random, np.random.Generator, np.random.RandomState), self._at_random_source),
            (weakref.ref, self._at_reference),
            (nn.Module, self._at_network_module),
            (torch.optim.Optimizer, self._at_optimizer),
        )
        for kind, look in looks:
            # Not `isinstance`, which would ask proxies that warn when they are looked at.
            if issubclass(type(value), kind):
                look(value, path)
                return
        wrapped = _own_attributes(value).get("__wrapped__")
        if wrapped is not None:  # functools.cache and its like
            self._ahead.append((wrapped, path))
        elif type(value).__module__ in _ITERATORS and issubclass(type(value), Iterator):
            self._at_iterator(value, path)
        else:
            self._at_instance(value, path)

    def _is_library(self, module: str | None) -> bool:
        package = package_of(module)
        return is_library(package) and package not in self._packages

    def _hold(
        self,
        owner: Any,
        path: str,
        read: Callable[[], Values],
        spell: Callable[[str, Hashable], str],
        what: str = "",
        table: Values | None = None,
    ) -> None:
        """Take note of the values in a place, and go on to each of them."""
        values = read()
        # One place is held once, with a path from each part.
        if (id(owner), what) not in self.found:
            # A read of the whole table gives the table itself.
            if values is table:
                pick = None
            else:
                pick = _picking(tuple(values))
            self.found[id(owner), what] = Held(owner, read, spell, [], table, pick)
        self.found[id(owner), what].paths.append(path)
        for key, value in values.items():
            self._ahead.append((value, spell(path, key)))

    # -- data ----------------------------------------------------------------------------------------------------

    def _at_listed(self, listed: Listed, path: str) -> None:
        self._hold(listed, path, listed.read, _attribute)

    def _at_tensor(self, tensor: Tensor, path: str) -> None:
        # Numbers of a tensor on another device than the env's become constants of a recording.
        if tensor.device.type != self._device.type:
            read = lambda: {"version": tensor._version}  # noqa: E731
            self._hold(tensor, path, read, _attribute)

    def _at_array(self, array: np.ndarray, path: str) -> None:
        if array.dtype != object:
            self._hold(array, path, lambda: {"content": checksum(array)}, _attribute)

    def _at_mapping(self, mapping: Values, path: str) -> None:
        if len(mapping) <= MOST_ITEMS:
            self._hold(mapping, path, lambda: mapping, _item, table=mapping)
        else:
            self._hold(mapping, path, lambda: {"length": len(mapping)}, _attribute)

    def _at_items(self, items: Collection[Any], path: str) -> None:
        if len(items) <= MOST_ITEMS:
            self._hold(items, path, lambda: dict(enumerate(items)), _item)
        else:
            self._hold(items, path, lambda: {"length": len(items)}, _attribute)

    def _at_fixed_items(self, items: Collection[Any], path: str) -> None:
        for index, value in enumerate(items):
            self._ahead.append((value, _item(path, index)))

    def _at_random_source(self, source: Any, path: str) -> None:
        self._hold(source, path, lambda: {"state": state_of(source)}, _attribute)

    def _at_iterator(self, iterator: Any, path: str) -> None:
        # Another Python may not tell where such an iterator stands.
        if place_of(iterator) is not None:
            self._hold(iterator, path, lambda: {"place": place_of(iterator)}, _attribute)

    def _at_generator(self, generator: types.GeneratorType, path: str) -> None:
        def read() -> Values:
            frame = generator.gi_frame
            if frame is None:
                return {"place": "its end"}
            # The iterated object is among its locals, or is the generator that it yields from.
            return {"place": frame.f_lasti, "source": generator.gi_yieldfrom, **frame.f_locals}

        self._hold(generator, path, read, _attribute)

    def _at_reference(self, reference: "weakref.ref[Any]", path: str) -> None:
        self._ahead.append((reference(), path))

    # -- objects -------------------------------------------------------------------------------------------------

    def _at_instance(self, value: Any, path: str) -> None:
        cls = type(value)
        # Objects of libraries are not entered; our own settings are, as users set their fields.
        is_settings = package_of(cls.__module__) == OURS and is_dataclass(cls)
        if self._is_library(cls.__module__) and not is_settings:
            return
        if _own_attributes(value):
            self._hold(value, path, lambda: vars(value), _attribute, table=vars(value))
        # Slots lie outside of the object's table.
        names = [name for base in cls.__mro__ for name in _slots(base)]
        if names:
            self._hold(
                value,
                path,
                lambda: {n: getattr(value, n, ABSENT) for n in names},
                _attribute,
                "slots",
            )
        self._ahead.append((cls, path))

    def _at_network_module(self, module: nn.Module, path: str) -> None:
        """Look at a transform, an env or a network, but not at attributes of its base in a library."""
        own = lambda: attributes_of(module)  # noqa: E731
        self._hold(module, path, own, _attribute, table=vars(module))
        # Submodules, buffers and parameters: that one is replaced by another is a change.
        for part in _MODULE_PARTS:
            entries = vars(module)[part]
            self._hold(entries, path, lambda entries=entries: entries, _attribute, table=entries)
        self._ahead.append((type(module), path))

    def _at_optimizer(self, optimizer: torch.optim.Optimizer, path: str) -> None:
        self._ahead.append((optimizer.param_groups, f"{path}.param_groups"))

    def _at_class(self, cls: type, path: str) -> None:
        if not self._reads_code:
            return
        for base in cls.__mro__:
            if not self._is_library(base.__module__):
                self._at_own_class(base, path)

    def _at_own_class(self, cls: type, path: str) -> None:
        def read() -> Values:
            named = vars(cls).items()
            return {name: value for name, value in named if name == "__call__" or name[:2] != "__"}

        def spell(path: str, name: Hashable) -> str:
            return f"{path}: {cls.__qualname__}.{name}"

        self._hold(cls, path, read, spell, table=vars(cls))

    def _at_module(self, module: types.ModuleType, path: str) -> None:
        """Do nothing: the names that a function reads of a module are looked at with the function."""

    # -- functions -----------------------------------------------------------------------------------------------

    def _at_function(self, function: types.FunctionType, path: str) -> None:
        if not self._reads_code:
            return
        self._at_closure(function, path)
        if "__wrapped__" in vars(function):
            self._ahead.append((vars(function)["__wrapped__"], path))
        if self._is_library(function.__module__):
            return
        self._ahead.append((function.__defaults__, f"{path}: defaults of {function.__qualname__}"))
        self._ahead.append(
            (function.__kwdefaults__, f"{path}: defaults of {function.__qualname__}")
        )
        own = f"{path}: {function.__qualname__}"
        self._hold(vars(function), own, lambda: vars(function), _attribute, table=vars(function))
        # Names in the code may be globals or attributes; those that exist as globals are watched.
        names = _names_in(function.__code__)
        scope = function.__globals__
        known = [name for name in names if name in scope]

        def spell(path: str, name: Hashable) -> str:
            return f"{path}: global {function.__module__}.{name}"

        def read() -> Values:
            return {name: scope.get(name, ABSENT) for name in known}

        self._hold(function, path, read, spell, what="globals", table=scope)
        for module in [scope[name] for name in known if isinstance(scope[name], types.ModuleType)]:
            if not self._is_library(module.__name__):
                self._at_names_of_module(module, names, path)

    def _at_closure(self, function: types.FunctionType, path: str) -> None:
        cells = function.__closure__
        if not cells:
            return
        names = function.__code__.co_freevars

        def spell(path: str, name: Hashable) -> str:
            return f"{path}: {name} in the closure of {function.__qualname__}"

        def read() -> Values:
            return {name: _content(cell) for name, cell in zip(names, cells, strict=True)}

        self._hold(function, path, read, spell, what="closure")

    def _at_names_of_module(
        self, module: types.ModuleType, names: Collection[str], path: str
    ) -> None:
        """Look at those attributes of a module that some code names, and so may read."""
        own = [name for name in names if name in vars(module)]

        def spell(path: str, name: Hashable) -> str:
            return f"{path}: global {module.__name__}.{name}"

        def read() -> Values:
            return {name: vars(module).get(name, ABSENT) for name in own}

        self._hold(module, path, read, spell, what=f"names of {path}", table=vars(module))

    def _at_method(self, method: types.MethodType, path: str) -> None:
        self._ahead.append((method.__self__, path))
        self._ahead.append((method.__func__, path))

    def _at_method_of_c(self, method: Any, path: str) -> None:
        self._ahead.append((method.__self__, path))

    def _at_partial(self, partial: "functools.partial[Any]", path: str) -> None:
        for value in (partial.func, partial.args, partial.keywords):
            self._ahead.append((value, path))

    def _at_property(self, given: property, path: str) -> None:
        self._ahead.append((given.fget, path))

    def _at_wrapper(
        self, wrapper: "staticmethod[Any, Any] | classmethod[Any, Any, Any]", path: str
    ) -> None:
        self._ahead.append((wrapper.__func__, path))

    def _at_cached_property(self, given: "functools.cached_property[Any]", path: str) -> None:
        self._ahead.append((given.func, path))


def attributes_of(module: nn.Module) -> dict[str, Any]:
    """Return the attributes of a transform, an env or a network, without those that its bases keep for themselves."""
    skipped = _names_of_bases(type(module))
    return {name: value for name, value in vars(module).items() if name not in skipped}


def _own_attributes(value: Any) -> Mapping[str, Any]:
    """Return the attributes in an object's `__dict__`; nothing where it has none."""
    try:
        return object.__getattribute__(value, "__dict__")
    except AttributeError:
        return {}


def _picking(keys: tuple[Hashable, ...]) -> Callable[[Values], tuple[Any, ...]]:
    """Return a function that takes the values of some keys from a table, faster than a loop; it may raise KeyError."""
    if not keys:
        return lambda _table: ()
    if len(keys) == 1:
        return lambda table: (table[keys[0]],)
    return operator.itemgetter(*keys)


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not yet given
        return ABSENT


def _slots(cls: type) -> tuple[str, ...]:
    slots = vars(cls).get("__slots__", ())
    if isinstance(slots, str):
        slots = (slots,)
    return tuple(name for name in slots if not name.startswith("__"))


@functools.cache
def _names_in(code: types.CodeType) -> tuple[str, ...]:
    """Return the names of globals and attributes that code uses, functions within it included."""
    names = dict.fromkeys(code.co_names)
    for constant in code.co_consts:
        # Code of inner functions and comprehensions lies among the constants.
        if inspect.iscode(constant):
            names |= dict.fromkeys(_names_in(constant))
    return tuple(names)


def _texts_in(code: types.CodeType) -> Iterator[str]:
    """Yield the texts in code, which may name attributes."""
    for constant in code.co_consts:
        if isinstance(constant, str):
            yield constant
        elif inspect.iscode(constant):
            yield from _texts_in(constant)


@functools.cache
def _names_of_bases(cls: type) -> frozenset[str]:
    """Return the private names that bases from libraries, or from this package, use for themselves."""
    names: set[str] = set()
    for base in cls.__mro__:
        if not is_library(package_of(base.__module__)):
            continue
        for value in vars(base).values():
            if isinstance(value, property):
                function = value.fget
            else:
                function = value
            if inspect.isfunction(function):
                names |= {*_names_in(function.__code__), *_texts_in(function.__code__)}
    names |= set(vars(nn.Module()))
    names.discard("training")
    return frozenset(name for name in names if name.startswith("_")) | _CHANGES_BY_ITSELF


def _attribute(path: str, key: Hashable) -> str:
    return f"{path}.{key}"


def _item(path: str, key: Hashable) -> str:
    return f"{path}[{key!r}]"
