"""The README's code runs as it stands and stays short."""

import re
import runpy
from pathlib import Path

import pytest

from ksim_rl.modules.network import ObservationNormalizer

README = Path(__file__).parents[1] / "README.md"


def block(kind: str) -> str:
    found = re.search(rf"<!-- test: {kind} -->\n```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert found, f"README has no block marked <!-- test: {kind} -->"
    return found.group(1)


@pytest.mark.parametrize(("kind", "limit"), [("python", 40), ("pytest", 20)])
def test_the_blocks_are_short(kind, limit):
    assert len(block(kind).splitlines()) <= limit


def test_the_python_block_runs_as_it_stands(tmp_path, monkeypatch, capsys):
    script = tmp_path / "composed.py"
    script.write_text(block("python"))
    monkeypatch.chdir(tmp_path)
    composed = runpy.run_path(str(script), run_name="__main__")
    for network in (composed["actor"], composed["critic"]):
        counts = [
            int(part.count) for part in network.modules() if isinstance(part, ObservationNormalizer)
        ]
        assert counts == [3 * 2048], "each env state counts once"
    assert capsys.readouterr().out.count("reward per step") == 3


def test_the_unit_test_passes_as_it_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    copied = tmp_path / "test_copied.py"
    copied.write_text(block("pytest"))
    (test,) = (
        value for name, value in runpy.run_path(str(copied)).items() if name.startswith("test_")
    )
    test()
