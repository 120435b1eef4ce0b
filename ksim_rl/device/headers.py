"""Reads the C++ headers of kernels: what they include, the struct that a kernel takes, and its constants.

A kernel is a header `x.cuh` whose namespace `x` has a struct `Arguments` and a function `run`. Includes are written as
paths from the root of the package, so that compilers and editors find them with that folder alone. Warp gets the text
of all headers of a kernel, so that its cache has a kernel for each text.
"""

import re
from collections.abc import Iterable, Mapping
from importlib.resources import files
from pathlib import PurePosixPath

_INCLUDE = re.compile(r'(?m)^#include "(.*)"\n')
_ARGUMENTS = re.compile(r"struct Arguments \{\n(.*?)\n\};", re.DOTALL)
_TYPE = r"(?:const )?(?:(?:unsigned|long) )*[\w:]+(?:<[\w:<>, ]+>)?\*?"
_FIELD = re.compile(rf"^ +({_TYPE}) (\w+);(?: +//.*)?$|^ *//.*$")
_LEFT = re.compile(r'(?m)^\s*#\s*include\s*".*')
_GIVEN = re.compile(r"namespace given \{\n(.*?)\n\}", re.DOTALL)
_OPENED = re.compile(r"(?<!using )\bnamespace given\b")
_CONSTANT = re.compile(r"(?m)^(constexpr int (\w+) = )(-?\d+);")
_GIVEN_LINE = re.compile(r"^constexpr int \w+ = -?\d+;(?: *//.*)?$|^(?: *//.*)?$")
WARP = "builtin.h"
"""Warp's own header, which stands before all of ours when Warp compiles them."""


def text_of(header: str, constants: Mapping[str, int] | None = None) -> str:
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


def _with_constants(header: str, text: str, constants: Mapping[str, int]) -> str:
    # A sample value must never reach a kernel: nothing is passed over.
    bodies = _GIVEN.findall(text)
    assert len(bodies) == len(_OPENED.findall(text)), (
        f"{header}: `namespace given {{` is a line of its own"
    )
    for line in "\n".join(bodies).splitlines():
        assert _GIVEN_LINE.match(line), (
            f"{header}: a constant that is given is a line `constexpr int NAME = 1;`, and no {line!r}"
        )
    declared: set[str] = set()

    def valued(constant: re.Match[str]) -> str:
        begin = constant[1]
        name = constant[2]
        value = constants.get(name, 0)
        assert abs(value) < 1 << 31, f"{header}: {name}={value} is no int of C++"
        declared.add(name)
        return f"{begin}{value:d};"

    text = _GIVEN.sub(lambda given: _CONSTANT.sub(valued, given[0]), text)
    assert declared == {*constants}, (
        f"{header}: constants {sorted(declared ^ {*constants})} are declared or given, but not both"
    )
    return text


def arguments_of(text: str) -> dict[str, str]:
    """Return the types of the fields of the last struct `Arguments` of a text, by name and in order, as in C++."""
    bodies = _ARGUMENTS.findall(text)
    assert bodies, "a header of a kernel has a line `struct Arguments {`, and fields behind it"
    fields: dict[str, str] = {}
    for line in bodies[-1].splitlines():
        field = _FIELD.match(line)
        assert field is not None, f"a field is a line of its own: {line!r}"
        if field[2]:
            fields[field[2]] = field[1]
    return fields


def call_of(header: str, indices: Iterable[str], values: Iterable[str]) -> str:
    """Return the call of a header's `run` with the indices of a thread, and its arguments in their order."""
    name = PurePosixPath(header).stem
    arguments = f"{name}::Arguments {{{', '.join(values)}}}"
    return f"{name}::run({', '.join([*indices, arguments])});"
