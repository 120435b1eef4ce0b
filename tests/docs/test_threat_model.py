"""The threat model lists what commands read and which ports they open: all of it, and functions that there are."""

import ast
import re
from collections.abc import Callable, Collection
from functools import cache
from pathlib import Path

import pytest

import ksim_rl

PACKAGE = Path(ksim_rl.__file__).parent
PAGE = PACKAGE.parent / "docs" / "threat_model.md"
FILES, PORTS = "## What is read, and by which function", "## Ports"
# Each file that may be a stranger's goes through one of these: `tests/files/test_reading.py` finds any other.
READS = {"read_bytes", "open_regular", "check_regular", "read_arrays", "read_yaml", "os.open"}
OPENS = {
    "viser.ViserServer",
    "serve",
    "dist.TCPStore",
    "dist.init_process_group",
    "HTTPServer",
    "socket.create_server",
    "asyncio.start_server",
    "listen",
}
# `serve` and `listen` of these modules are functions of their own.
OWN_NAMES = {"viewer/play_command.py", "export/standalone/loop_command.py"}
# They are what the others call, or open folders to flush and lock them.
ROOM = {"files/reading.py", "files/writing.py"}


def section(title: str) -> str:
    """Return the text of the page below a title."""
    return PAGE.read_text().split(f"{title}\n", 1)[1].split("\n## ", 1)[0]


def named(title: str) -> list[tuple[str, str]]:
    """Return the pairs of a function and its file that a section names, where several may have one file."""
    found = []
    for functions, file in re.findall(
        r"((?:`\w+`(?:, | and )?)+) \(`([\w/]+\.py)`\)", section(title)
    ):
        found += [(name, file) for name in re.findall(r"`(\w+)`", functions)]
    return found


@cache
def calls() -> dict[str, set[str]]:
    """Return the texts of functions that each module calls, such as `np.load`."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        nodes = ast.walk(ast.parse(path.read_text()))
        texts = {ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)}
        found[path.relative_to(PACKAGE).as_posix()] = texts
    return found


def modules_that(is_call: Callable[[str], bool]) -> set[str]:
    """Return the modules with a call whose text passes."""
    return {module for module, texts in calls().items() if any(map(is_call, texts))}


def defined(file: str) -> Collection[str]:
    tree = ast.parse((PACKAGE / file).read_text())
    kinds = (ast.FunctionDef, ast.ClassDef)
    return {node.name for node in ast.walk(tree) if isinstance(node, kinds)}


@pytest.mark.parametrize("title", [FILES, PORTS])
def test_each_function_that_is_named_is_there(title):
    pairs = named(title)
    assert len(pairs) >= 4
    assert [(name, file) for name, file in pairs if name not in defined(file)] == []


def test_each_module_that_reads_a_file_is_named():
    reading = modules_that(READS.__contains__) - ROOM
    files = {file for _, file in named(FILES)}
    # One that flushes a folder or a file has its name there for what it reads.
    assert len(reading) > 25
    assert sorted(reading - files) == []


def opens(called: str) -> bool:
    return called in OPENS or called.endswith((".bind", ".listen"))


def test_each_module_that_opens_a_port_is_named():
    opening = modules_that(opens) - OWN_NAMES
    # MuJoCo's batches and views have a `bind` of their own.
    opening = {file for file in opening if not file.startswith("physics/")}
    assert "viewer/pad.py" in opening
    assert sorted(opening - {file for _, file in named(PORTS)}) == []


def test_what_is_left_out_is_found(monkeypatch):
    monkeypatch.setitem(globals(), "section", lambda title: "")
    for test in (
        test_each_module_that_reads_a_file_is_named,
        test_each_module_that_opens_a_port_is_named,
    ):
        with pytest.raises(AssertionError):
            test()
