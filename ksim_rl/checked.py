"""Config dataclasses that inherit `Checked` hold, once built, values that fit the annotations of their fields.

Bounds stand in the annotation: `stiffness: Positive`, `share: Share = 0.5`, `x: Annotated[float, Within(high=3.0)]`.
Whole numbers without an upper one end at 32 bits. Only rules that relate several fields need code: a method
`_check_fields`.
"""

import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, Literal, TypeAlias

from ksim_rl.checks import MOST_COUNT, check_choice, check_count, check_in_range, check_pair

# A type hint. Python has no type of these before `TypeForm`.
Annotation: TypeAlias = Any


@dataclass(frozen=True)
class Within:
    """Bounds of a number, or of each number of a tuple: `[low, high]`, `(low, high]` with `low_open`.

    `ordered` says that a pair is a range, whose first number must not exceed the second.
    """

    low: float | None = None
    high: float | None = None
    low_open: bool = False
    ordered: bool = False

    def check(self, field: str, value: object) -> None:
        """Refuse a value outside, by a ValueError that names the field and the bounds; None passes."""
        # Whether None is allowed is said by the union around.
        if value is None:
            return
        if self.ordered:
            check_pair(field, value, low=self.low, high=self.high)
        elif isinstance(value, (list, tuple)):
            for index, number in enumerate(value):
                self.check(f"{field}[{index}]", number)
        else:
            check_in_range(field, value, low=self.low, high=self.high, low_open=self.low_open)


@dataclass(frozen=True)
class Filled:
    """Says that a text, a sequence or a mapping is not empty, with an `advice` for empty ones."""

    advice: str


# The bounds that configs share, by name.
Positive = Annotated[float, Within(low=0.0, low_open=True)]
NonNegative = Annotated[float, Within(low=0.0)]
Share = Annotated[float, Within(low=0.0, high=1.0)]
Count = Annotated[int, Within(low=1)]
WholeNumber = Annotated[int, Within(low=0)]
# What is repeated within one step or iteration: with more of them nothing would be heard of a run for hours.
Repeats = Annotated[int, Within(low=1, high=10_000)]
# Seeds of evaluations lie above a run's own, and must fit 64 bits as well.
Seed = Annotated[int, Within(low=0, high=2**62)]
# Of all envs over a whole training: 32 bits are too few.
Total = Annotated[int, Within(low=0, high=2**62)]
Range = Annotated[tuple[float, float], Within(ordered=True)]
NonNegativeRange = Annotated[tuple[float, float], Within(low=0.0, ordered=True)]
Name = Annotated[str, Filled("expected a name")]

# A weight itself, its gradient, and the two moments of Adam.
NUMBERS_PER_WEIGHT = 4


class Checked:
    """A base of dataclasses whose fields are checked against their annotations when one is built.

    A ValueError names the field, the value and the valid ones.
    """

    def __post_init__(self) -> None:
        """Check every field, and then the rules about several fields of each class, bases first."""
        hints = _hints(type(self))
        for field in fields(typing.cast(Any, self)):
            check_value(field.name, getattr(self, field.name), hints[field.name])
        self._check_fields()

    def _check_fields(self) -> None:
        """Refuse fields that contradict each other. Overrides call `super()._check_fields()` first."""

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return how many numbers of four bytes must lie in memory at least, by the names of the fields that say so.

        Numbers of configs in its fields are left out. `ksim_rl.device.room.check_room` compares them with a machine.
        """
        return {}

    def data_files(self) -> Sequence[str]:
        """Return the files of data that the config names, as it names them: motions and networks of motors.

        Files of configs in its fields are left out. A run keeps the hashes (`ksim_rl.trainers.kept_models`).
        """
        return ()


def parts(value: object, path: str = "") -> Iterator[tuple[str, Checked]]:
    """Yield the configs in a config, itself first, each with its dotted path."""
    if isinstance(value, Mapping):
        for name, entry in value.items():
            yield from parts(entry, f"{path}.{name}".removeprefix("."))
    elif isinstance(value, tuple | list):
        for index, entry in enumerate(value):
            yield from parts(entry, f"{path}[{index}]")
    elif isinstance(value, Checked) and is_dataclass(value):
        yield path, value
        for field in fields(value):
            yield from parts(getattr(value, field.name), f"{path}.{field.name}".removeprefix("."))


def named_files(value: object) -> set[str]:
    """Return the files of data that a config and the configs in it name."""
    return {file for _, part in parts(value) for file in part.data_files()}


def numbers_of_layers(widths: Sequence[int]) -> float:
    """Return how many numbers layers of these widths need to learn, for the weights between them and the biases."""
    weights = sum(below * above for below, above in pairwise(widths))
    return NUMBERS_PER_WEIGHT * (sum(widths) + weights)


@cache
# Resolving texts of annotations is slow, and classes do not change.
def _hints(cls: type) -> dict[str, Annotation]:
    return typing.get_type_hints(cls, include_extras=True)


def check_value(field: str, value: object, annotation: Annotation) -> None:
    """Refuse a value that does not fit an annotation, as `checks` do; protocols, callables and `Any` take all."""
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if annotation is Any:  # a class since Python 3.11, but none to ask `isinstance` of
        return
    if origin is Annotated:
        # Numbers have their bounds checked by one message, pairs and unions by theirs.
        for bound in (extra for extra in arguments[1:] if isinstance(extra, Within)):
            if arguments[0] is int and bound.low is not None:
                high = MOST_COUNT if bound.high is None else int(bound.high)
                check_count(field, value, low=int(bound.low), high=high)
            elif arguments[0] in (int, float):
                check_in_range(
                    field, value, low=bound.low, high=bound.high, low_open=bound.low_open
                )
            elif value is None or not bound.ordered:
                check_value(field, value, arguments[0])
            # Ranges and tuples of numbers.
            bound.check(field, value)
        check_value(field, value, arguments[0])
        for extra in arguments[1:]:
            if isinstance(extra, Filled) and not value:
                raise ValueError(f"{field}={value!r}: {extra.advice}")
    elif origin in (typing.Union, types.UnionType):
        _check_union(field, value, arguments)
    # The valid values are listed.
    elif origin is Literal:
        check_choice(field, value, arguments)
    elif origin is tuple or origin is Sequence:
        _check_sequence(field, value, annotation)
    elif origin is Mapping or origin is dict:
        if not isinstance(value, Mapping):
            raise ValueError(f"{field}={value!r}: expected a mapping")
        for key, entry in value.items():
            check_value(f"{field} key {key!r}", key, arguments[0])
            check_value(f"{field}.{key}", entry, arguments[1])
    # A whole number is a valid float, a truth value is not.
    elif annotation is float:
        check_in_range(field, value)
    # Protocols would need all of their methods looked at; mistakes show when they are called.
    elif isinstance(annotation, type) and not getattr(annotation, "_is_protocol", False):
        _check_instance(field, value, annotation)


def _check_instance(field: str, value: object, kind: type) -> None:
    # bool is a subclass of int in Python.
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        expected = {int: "a whole number", str: "a text", bool: "true or false"}.get(
            kind, f"a {kind.__name__}"
        )
        raise ValueError(f"{field}={value!r}: expected {expected}")


def _check_union(field: str, value: object, options: Sequence[Annotation]) -> None:
    # None is no error where the union names it.
    if value is None and type(None) in options:
        return
    errors = []
    for option in options:
        if option is type(None):
            continue
        try:
            check_value(field, value, option)
            return
        except ValueError as error:
            errors.append(str(error))
    # All options failed, so the error lists the reason of each.
    raise ValueError("; or ".join(errors))


def _check_sequence(field: str, value: object, annotation: Annotation) -> None:
    arguments = typing.get_args(annotation)
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"{field}={value!r}: expected a list")
    # A homogeneous tuple or sequence of any length, or a tuple with a type for each place.
    if typing.get_origin(annotation) is Sequence or arguments[1:] == (...,):
        kinds: Sequence[Annotation] = [arguments[0]] * len(value)
    elif len(value) == len(arguments):
        kinds = arguments
    else:
        raise ValueError(f"{field}={value!r}: expected {len(arguments)} entries")
    for index, (entry, kind) in enumerate(zip(value, kinds, strict=True)):
        check_value(f"{field}[{index}]", entry, kind)
