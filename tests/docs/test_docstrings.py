"""Docstrings of modules begin with what the module is or does."""

import ast
import re

import pytest

from tests.docs.guide import REPOSITORY

FOLDERS = ("ksim_rl", "benchmarks", "examples")
# What is said of every module says nothing of this one.
EMPTY = re.compile(r"This (module|room|package|folder|file|program|command|benchmark)\b")


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_module_begins_with_this_module(folder: str) -> None:
    found = []
    for file in sorted((REPOSITORY / folder).rglob("*.py")):
        text = ast.get_docstring(ast.parse(file.read_text())) or ""
        if EMPTY.match(text):
            found.append(f"{file.relative_to(REPOSITORY)}: {text.splitlines()[0]}")
    assert not found, "begin with what the module is or does, such as 'Reads BVH files'"
