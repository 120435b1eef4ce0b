"""What lies in the working directory changes no picture, and names are no formulas."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import ksim_rl
from ksim_rl.runs import curves

TABLE = "iteration,env_states,episode/return\n1,4,0.5\n2,8,0.75\n"
DRAW = (
    "import sys; from pathlib import Path; from ksim_rl.runs import curves; "
    "curves.draw(Path(sys.argv[1]), Path(sys.argv[2]), title='a run')"
)


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(TABLE)
    return path


def become_pipe(path):
    os.mkfifo(path)


def become_settings(path):
    path.write_text("text.usetex: True\naxes.facecolor: red\nfont.size: 40\n")


@pytest.mark.parametrize("trap", [become_pipe, become_settings])
def test_settings_of_the_working_directory_are_not_read(trap, table, tmp_path):
    stands = tmp_path / "stands"
    stands.mkdir()
    trap(stands / "matplotlibrc")
    there, here = tmp_path / "there.png", tmp_path / "here.png"
    command = [sys.executable, "-P", "-c", DRAW, str(table), str(there)]
    subprocess.run(command, cwd=stands, timeout=60, check=True)
    curves.draw(table, here, title="a run")
    assert there.read_bytes() == here.read_bytes()


def test_a_name_with_dollars_is_no_formula(table, tmp_path):
    curves.draw(table, tmp_path / "curves.png", title=r"$\no_such_symbol{$")
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_one_module_imports_matplotlib():
    package = Path(ksim_rl.__file__).parent
    found = set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            if any(name.split(".")[0] == "matplotlib" for name in names):
                found.add(path.relative_to(package).as_posix())
    assert found == {"runs/plotting.py"}
