"""Reads the C++ headers of kernels: what they include, the struct that a kernel takes, and its constants.

A kernel is a header `x.cuh` whose namespace `x` has a struct `Arguments` and a function `run`. Includes are written as
paths from the root of the package, so that compilers and editors find them with that folder alone. Warp gets the text
of all headers of a kernel, so that its cache has a kernel for each text.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import PurePosixPath
from typing import TypeAlias

_INCLUDE = re.compile(r'(?m)^#include "(.*)"\n')
_STRUCT = re.compile(r"(?m)^struct (\w+)(?: : ([\w:, ]+))? \{\n(?:((?:.|\n)*?)\n)?\};")
_TYPE = r"(?:const )?(?:(?:unsigned|long) )*[\w:]+(?:<[\w:<>, ]+>)?\*?"
_FIELD = re.compile(rf"^ +({_TYPE}) (\w+);(?: +//.*)?$|^ *//.*$")
_LEFT = re.compile(r'(?m)^\s*#\s*include\s*".*')
_GIVEN = re.compile(r"namespace given \{\n(.*?)\n\}", re.DOTALL)
_OPENED = re.compile(r"(?<!using )\bnamespace given\b")
_INT = r"-?\d+"
_VALUED = rf"constexpr int (\w+)(?: = {_INT}|\[\] = {{{_INT}(?:, {_INT})*}});"
_CONSTANT = re.compile(rf"(?m)^{_VALUED}")
_GIVEN_LINE = re.compile(rf"^{_VALUED}(?: *//.*)?$|^(?: *//.*)?$")
Constant: TypeAlias = int | Sequence[int]
"""The value of a constant that is given: a number, or the numbers of a table."""
WARP = "builtin.h"
"""Warp's own header, which stands before all of ours when Warp compiles them."""


def text_of(header: str, constants: Mapping[str, Constant] | None = None) -> str:
    """Return the text of a header behind the headers that it includes, each once.

    Args:
        header: its path, such as `ksim_rl/ranks/moments.cuh`.
        constants: the values of those in the namespaces `given` of these headers, all of them by name.
    """
    texts: dict[str, str] = {}
    _collect(header, texts)
    text = "".join(texts.values())
    return _with_constants(header, text, constants or {})


def _collect(header: str, texts: dict[str, str]) -> None:
    package, _, path = header.partition("/")
    text = files(package).joinpath(path).read_text()
    for included in _INCLUDE.findall(text):
        if included not in texts and included != WARP:
            _collect(included, texts)
    text = _INCLUDE.sub("", text).replace("#pragma once\n", "")
    # Where a compiler found the file by itself, no cache would know its text.
    left = _LEFT.search(text)
    assert left is None, f"{header}: an include is a line of its own: {left and left[0]!r}"
    texts[header] = text


def _with_constants(header: str, text: str, constants: Mapping[str, Constant]) -> str:
    # A sample value must never reach a kernel: nothing is passed over.
    bodies = _GIVEN.findall(text)
    assert len(bodies) == len(_OPENED.findall(text)), (
        f"{header}: `namespace given {{` is a line of its own"
    )
    for line in "\n".join(bodies).splitlines():
        assert _GIVEN_LINE.match(line), (
            f"{header}: a constant that is given is a line `constexpr int NAME = 1;`, or of a table "
            f"`constexpr int NAME[] = {{1, 2}};`, and no {line!r}"
        )
    declared: set[str] = set()

    def valued(constant: re.Match[str]) -> str:
        name = constant[1]
        declared.add(name)
        # One that is not given is refused below, with all others.
        if name in constants:
            return _declaration(header, constant, constants[name])
        return constant[0]

    text = _GIVEN.sub(lambda given: _CONSTANT.sub(valued, given[0]), text)
    assert declared == {*constants}, (
        f"{header}: constants {sorted(declared ^ {*constants})} are declared or given, but not both"
    )
    return text


def _declaration(header: str, sample: re.Match[str], value: Constant) -> str:
    """Return the line of a constant with its value in place of the sample."""
    name = sample[1]
    is_table = isinstance(value, Sequence)
    assert is_table == ("[]" in sample[0]), f"{header}: {name}={value}, and there {sample[0]!r}"
    numbers = value if isinstance(value, Sequence) else [value]
    assert numbers, f"{header}: the table {name} is empty"
    for number in numbers:
        assert abs(number) < 1 << 31, f"{header}: {name}={number} is no int of C++"
    written = ", ".join(f"{number:d}" for number in numbers)
    if is_table:
        return f"constexpr int {name}[] = {{{written}}};"
    return f"constexpr int {name} = {written};"


def arguments_of(text: str) -> dict[str, str]:
    """Return the types of the fields of the last struct `Arguments` of a text, by name and in order, as in C++.

    The fields of structs that it inherits from, which several kernels may share, come first.
    """
    structs = _STRUCT.findall(text)
    arguments = [struct for struct in structs if struct[0] == "Arguments"]
    assert arguments, "a header of a kernel has a line `struct Arguments {`, and fields behind it"
    fields: dict[str, str] = {}
    _add_fields(arguments[-1], structs, fields)
    return fields


def _add_fields(
    struct: tuple[str, str, str], structs: list[tuple[str, str, str]], fields: dict[str, str]
) -> None:
    """Add the fields of a struct: its name, its bases and its lines."""
    name, bases, lines = struct
    for base in filter(None, bases.split(", ")):
        named = [other for other in structs if other[0] == base.rpartition("::")[2]]
        assert len(named) == 1, f"{name} inherits from {base!r}, which one struct has to be"
        _add_fields(named[0], structs, fields)
    for line in lines.splitlines():
        field = _FIELD.match(line)
        assert field is not None, f"a field is a line of its own: {line!r}"
        if field[2]:
            assert field[2] not in fields, f"{name} has a field twice: {field[2]}"
            fields[field[2]] = field[1]


def call_of(header: str, indices: Iterable[str], values: Iterable[str]) -> str:
    """Return the call of a header's `run` with the indices of a thread, and its arguments in their order."""
    name = PurePosixPath(header).stem
    arguments = f"{name}::Arguments {{{', '.join(values)}}}"
    return f"{name}::run({', '.join([*indices, arguments])});"
