"""Wrong values for each field of each config dataclass of the package; `figures()` counts what was not refused by name.

`python -m tests.wrong_configs` prints the figures.
"""

import dataclasses
import importlib
import inspect
import pkgutil
import sys
import typing
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import ksim_rl
from ksim_rl import conf, envs
from ksim_rl.checked import Checked, Within

WRONG: tuple[Any, ...] = (
    *(None, True, 1, -1, 1.5, float("nan"), float("inf"), "x", "", b"x", object(), int, len),
    *([], [1], ["x"], [None], [[1]], (1, 2, 3), {}, {"a": 1}, {1: 2}, {1, 2}),
)


def classes() -> list[type]:
    """Return the dataclasses of the package that users fill in."""
    for module in pkgutil.walk_packages(ksim_rl.__path__, "ksim_rl."):
        # A command line runs where it is imported by this name, and extras may be missing.
        if not module.name.endswith("__main__"):
            try:
                importlib.import_module(module.name)
            except ImportError:
                continue
    found = {
        kind
        for name, module in list(sys.modules.items())
        if name.startswith("ksim_rl")
        for kind in vars(module).values()
        if inspect.isclass(kind) and issubclass(kind, Checked) and dataclasses.is_dataclass(kind)
    }
    return sorted(found, key=lambda kind: (kind.__module__, kind.__qualname__))


def examples() -> dict[type, Any]:
    """Return a good instance of each class that stands in some task's config or needs no arguments."""
    found: dict[type, Any] = {}

    def take(value: Any) -> None:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            found.setdefault(type(value), value)
            for field in dataclasses.fields(value):
                take(getattr(value, field.name))
        elif isinstance(value, Mapping):
            for entry in value.values():
                take(entry)
        elif isinstance(value, (list, tuple)):
            for entry in value:
                take(entry)

    take(conf.compose([]))
    for name in envs.names():
        task = envs.task(name)
        take(task.training)
        try:
            take(task.cfg())
        except ValueError:  # a robot that is not here
            continue
    for kind in classes():
        if kind not in found and not inspect.isabstract(kind):
            try:
                take(kind())
            except (TypeError, ValueError):
                continue
    return {kind: value for kind, value in found.items() if kind.__module__.startswith("ksim_rl")}


def tries(only: Collection[str] = ()) -> Iterator[tuple[type, str, Any, Any]]:
    """Yield class, field and wrong value, with the error that it gave, or None; of fields of some names or of all."""
    for kind, good in examples().items():
        for field in dataclasses.fields(good):
            for value in WRONG if field.init and (not only or field.name in only) else ():
                try:
                    dataclasses.replace(good, **{field.name: value})
                    error = None
                except Exception as raised:
                    error = raised
                yield kind, field.name, value, error


def figures(only: Collection[str] = ()) -> dict:
    """Return how many values were tried, and those that gave another error, one that names no field, or none."""
    others, unnamed, taken, count, fields = [], [], [], 0, set()
    for kind, name, value, error in tries(only):
        count += 1
        fields.add((kind, name))
        what = f"{kind.__name__}.{name}={value!r}: {type(error).__name__}: {error}"[:200]
        names = [field.name for field in dataclasses.fields(kind)]
        if error is not None and not isinstance(error, ValueError):
            others.append(what)
        elif error is not None and not any(own in str(error) for own in names):
            unnamed.append(what)
        elif error is None and not _may_be(
            typing.get_type_hints(kind, include_extras=True)[name], value
        ):
            taken.append(what)
    return {
        "tries": count,
        "fields": len(fields),
        "other_errors": others,
        "unnamed": unnamed,
        "taken": taken,
    }


def _may_be(annotation: Any, value: Any) -> bool:
    """Whether an annotation allows a value, told apart from `check_value` for the plain kinds of fields only."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        bounds = [extra for extra in arguments[1:] if isinstance(extra, Within)]
        outside = isinstance(value, (int, float)) and any(
            bound.low is not None and value < bound.low for bound in bounds
        )
        return not outside and _may_be(arguments[0], value)
    if annotation is bool:
        return isinstance(value, bool)
    if annotation is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if annotation is float:
        return (
            isinstance(value, (int, float))
            and not isinstance(value, bool)
            and abs(value) < float("inf")
        )
    if annotation is str:
        return isinstance(value, str)
    return True


if __name__ == "__main__":
    for key, entry in figures().items():
        print(
            key,
            entry if isinstance(entry, int) else len(entry),
            *(entry if isinstance(entry, list) else ())[:400],
            sep="\n  ",
        )
