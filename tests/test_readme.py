"""The README's code runs as it stands and stays short."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def block(kind: str) -> str:
    found = re.search(rf"<!-- test: {kind} -->\n```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert found, f"README has no block marked <!-- test: {kind} -->"
    return found.group(1)


@pytest.mark.parametrize(("kind", "limit"), [("python", 40), ("pytest", 20)])
def test_the_blocks_are_short(kind, limit):
    assert len(block(kind).splitlines()) <= limit


def test_the_python_block_runs_as_it_stands(tmp_path):
    script = tmp_path / "composed.py"
    script.write_text(block("python"))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("reward per step") == 3


def test_the_unit_test_passes_as_it_stands(tmp_path):
    (tmp_path / "test_copied.py").write_text(block("pytest"))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_copied.py"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr
