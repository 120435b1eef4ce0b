"""Every process is started by one function, and runs nothing that lies in the folder in which the user stands."""

import ast
import os
import sys
from pathlib import Path
from subprocess import TimeoutExpired

import pytest

from benchmarks.faults.hostile_folder import write_modules
from ksim_rl.config import child_processes, plugins
from ksim_rl.config.child_processes import ask_git, run_python
from ksim_rl.scene.rendering import rendering

PACKAGE = Path(plugins.__file__).parents[1]
STARTS = {"config/child_processes.py"}
# It runs without this library, and its workers are as isolated as it is; one that asks which process it is; and one
# that waits in the event loop of a server.
OTHERS = {
    "export/standalone/command.py": {
        "multiprocessing",
        "concurrent.futures",
        "concurrent.futures.process",
    },
    "transforms/upstream.py": {"multiprocessing"},
    "viewer/guarded_server.py": {"asyncio"},
}
# Words for what is started elsewhere, and threads.
HARMLESS = {"PIPE", "STDOUT", "TimeoutExpired", "Popen", "ThreadPoolExecutor", "Future"}
STARTERS = {"subprocess", "multiprocessing", "pty", "concurrent"}
CALLS = {
    "Popen",
    "system",
    "popen",
    "fork",
    "forkpty",
    "posix_spawn",
    "posix_spawnp",
    "start_processes",
    "create_subprocess_exec",
    "create_subprocess_shell",
}


def starters(tree):
    """Return what a module names that starts processes."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {entry.name for entry in node.names if entry.name.split(".")[0] in STARTERS}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in STARTERS:
            names = {entry.name for entry in node.names}
            if names - HARMLESS:
                found.add(node.module)
        elif isinstance(node, ast.Attribute) and ast.unparse(node) == "sys.executable":
            found.add("sys.executable")
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func).split(".")[-1]
            if (
                name in CALLS
                or name.startswith(("exec", "spawn"))
                and ast.unparse(node.func).startswith("os.")
            ):
                found.add(name)
    return found


def test_one_module_starts_processes():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if name not in STARTS:
            found[name] = starters(ast.parse(path.read_text())) - OTHERS.get(name, set())
    assert {name: seen for name, seen in found.items() if seen} == {}


@pytest.mark.parametrize(
    "text",
    [
        "import subprocess\n",
        "from subprocess import run\n",
        "from subprocess import Popen\nPopen(['x'])\n",
        "import os\nos.system('x')\n",
        "import os\nos.execv('x', [])\n",
        "import sys\nprint(sys.executable)\n",
        "from concurrent.futures import ProcessPoolExecutor\n",
    ],
)
def test_the_search_finds_others(text):
    assert starters(ast.parse(text))


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """Stand in a folder with modules that leave a mark, and return what lists the marks."""
    (tmp_path / "stranger").mkdir()
    write_modules(tmp_path / "stranger", marks=tmp_path / "marks")
    monkeypatch.chdir(tmp_path / "stranger")
    return lambda: sorted(path.name for path in (tmp_path / "marks").iterdir())


def test_a_child_imports_nothing_from_the_working_directory(stranger):
    done = run_python(["-c", "import mujoco"])
    assert done.returncode == 0, done.stderr
    assert stranger() == []


def test_the_marks_are_left_without_the_flag(stranger, monkeypatch):
    monkeypatch.setattr(child_processes, "START", os.getcwd())
    real = child_processes.subprocess.Popen
    monkeypatch.setattr(
        child_processes.subprocess,
        "Popen",
        lambda words, **how: real([words[0], *words[2:]], **how),
    )
    run_python(["-c", "import mujoco"])
    assert stranger() == ["mujoco"]


def test_a_platform_to_draw_with_is_found_in_a_strangers_folder(stranger, monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY"):
        # Empty, and not deleted: what the choice writes into a variable that was absent would stay.
        monkeypatch.setenv(name, "")
    monkeypatch.setattr(rendering.importlib, "reload", lambda module: None)
    try:
        rendering.choose_gl_platform.__wrapped__()
    except RuntimeError as error:
        assert "no OpenGL platform" in str(error)
    assert stranger() == []


def test_a_child_finds_plug_ins_by_their_absolute_path(tmp_path, monkeypatch):
    (tmp_path / "mine_for_children.py").write_text("NAME = 'found'\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(plugins, "_named", [])
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.setenv(plugins.PATH_VARIABLE, "")
    said = []
    plugins.load_from_here(["mine_for_children"], note=said.append)
    monkeypatch.delitem(sys.modules, "mine_for_children")
    assert said == [
        f"--plugin mine_for_children: taken from {tmp_path}, where Python finds modules from now on"
    ]
    program = "from ksim_rl.config import plugins; plugins.load(()); import mine_for_children as m; print(m.NAME)"
    done = run_python(["-c", program])
    assert done.stdout == "found\n", done.stderr


def test_a_child_stands_where_nothing_of_ours_lies_until_it_goes_to_its_parents_folder(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    program = (
        "import os; print(os.getcwd()); from ksim_rl.config.child_processes import go_to_parents_folder as go; "
        "go(); print(os.getcwd())"
    )
    assert run_python(["-c", program]).stdout == f"/\n{tmp_path}\n"


def test_a_child_that_takes_too_long_is_killed():
    with pytest.raises(TimeoutExpired):
        run_python(["-c", "import time; time.sleep(600)"], seconds=0.5)


def test_git_says_nothing_about_a_folder_without_a_repository(tmp_path):
    assert ask_git(tmp_path, "rev-parse", "HEAD") is None
