"""What a terminal would obey is never printed: names from files, errors, tables, tracebacks, warnings."""

import ast
import io
import os
import warnings
from pathlib import Path

import pytest
from rich.console import Console

from ksim_rl import terminal
from ksim_rl.cli import main
from ksim_rl.cli.errors import report
from ksim_rl.cli.runs import print_table
from ksim_rl.terminal import printable, show, show_warnings_as_lines
from ksim_rl.trainers.progress import RunProgress

PACKAGE = Path(terminal.__file__).parent
EVIL = "a\x1b]0;title\x07\x9b31m\u202eb\rc\x08\udcffd"
COMMANDS = ("eval", "resume", "play", "export", "sim2sim", "diagnose", "runs", "compare")
OBEYED = set("\x1b\x07\x9b\u202e\r\x08")
# A console into memory, whose text is shown later; words between a process and its child; a program that stands alone.
OTHERS = {
    "envs/explain.py": {"console.print"},
    "export/standalone/command.py": {"print"},
    "export/standalone/loop_command.py": {"print"},
    "scene/robots/analysis.py": {
        "Console(file=text, force_jupyter=False, width=240, highlight=False).print"
    },
    "cli/runs.py": {"Console(highlight=False, width=None if console.is_terminal else 400).print"},
    "terminal.py": {"print"},
    "trainers/progress.py": {"print", "self.console.print"},
    "trainers/trial.py": {"print"},
    "viewer/live_training.py": {"print"},
}


def printers(tree):
    """Return what a module prints by."""
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    called = (ast.unparse(call.func) for call in calls)
    return {
        name
        for name in called
        if name == "print" or name.endswith((".print", "sys.stderr.write", "sys.stdout.write"))
    }


def test_one_module_prints():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        found[name] = printers(ast.parse(path.read_text())) - OTHERS.get(name, set())
    assert {name: seen for name, seen in found.items() if seen} == {}


def test_control_codes_become_spaces_and_lines_stay_lines(capsys):
    assert printable(EVIL) == "a ]0;title  31m b c \\xffd"
    show(f"one\n{EVIL}\ttwo")
    assert capsys.readouterr().out == f"one\n{printable(EVIL)} two\n"


@pytest.mark.parametrize("error", [ValueError, KeyError, MemoryError])
def test_errors_are_shown_without_them(error, capsys, monkeypatch):
    monkeypatch.setenv("KSIM_RL_TRACEBACK", "1")
    report(error(EVIL), about=EVIL)
    said = capsys.readouterr().err
    assert not OBEYED & set(said) and said.splitlines()[-1].startswith("ksim-rl: error: a ]0;title")


def test_tables_and_notes_are_shown_without_them(capsys):
    print_table(("run",), [[EVIL]])
    text = io.StringIO()
    for is_terminal in (False, True):
        console = Console(file=text, force_terminal=is_terminal, color_system=None, width=200)
        progress = RunProgress(1, console=console)
        progress.note(EVIL)
        progress.status(EVIL)
    assert not OBEYED & set(capsys.readouterr().out + text.getvalue())


def test_warnings_are_one_line_without_them(monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    show_warnings_as_lines()
    said = warnings.formatwarning(f"{EVIL}\nsecond", UserWarning, f"/somewhere/{EVIL}.py", 3)
    assert not OBEYED & set(said) and said.count("\n") == 1
    assert said.startswith("a ]0;title") and ".py:3: UserWarning: a ]0;title" in said


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("name", [EVIL.encode("utf-8", "surrogateescape"), b"\xff\xfe"])
def test_a_folder_of_any_name_is_named_in_one_line(command, name, tmp_path, monkeypatch, capsys):
    folder = os.fsencode(tmp_path) + b"/" + name
    os.mkdir(folder)
    for place in (os.fsdecode(folder), os.path.join(os.fsdecode(folder), "none")):
        words = [command, place, place] if command == "compare" else [command, place]
        with pytest.raises(SystemExit) as stopped:
            main.main(words)
        said = capsys.readouterr()
        assert stopped.value.code == (0 if said.out.startswith("no runs in") else 2)
        assert (
            not OBEYED & set(said.out + said.err) and len((said.out + said.err).splitlines()) == 1
        )
