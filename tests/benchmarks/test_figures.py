"""Figures are old once something that they measure was changed."""

import json
import subprocess

import pytest

from benchmarks import figures, report
from benchmarks.faults.rows import ROWS


@pytest.fixture
def checkout(tmp_path):
    """Make a repository with two results, measured at its first commit."""

    def git(*words):
        own = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        done = subprocess.run(
            ["git", *own, *words], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    for path in ("ksim_rl/physics/world.py", "ksim_rl/transforms/noise.py", "docs/page.md"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text("old")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "first")
    for name in ("agreement", "transforms"):
        run = {
            "command": f"python -m benchmarks.{name}",
            "commit": git("rev-parse", "HEAD"),
            "date": "2026",
        }
        (tmp_path / f"{name}.json").write_text(json.dumps({**run, "runs": {"cpu/a": run}}))
    return tmp_path, git


def names(root):
    return [entry.figures for entry in figures.old(root, root)]


def test_figures_are_new_until_what_they_measure_changes(checkout):
    root, git = checkout
    (root / "docs" / "page.md").write_text("new")
    git("commit", "-qam", "a page")
    assert names(root) == []
    (root / "ksim_rl" / "physics" / "world.py").write_text("new")
    git("commit", "-qam", "physics")
    (entry,) = figures.old(root, root)
    assert (
        entry.figures == "agreement.json cpu/a"
        and entry.command == "python -m benchmarks.agreement"
    )
    assert "ksim_rl/physics/world.py changed since" in entry.because


def test_a_commit_that_is_not_known_and_a_result_that_nobody_declared_are_said(checkout):
    root, _ = checkout
    saved = json.loads((root / "agreement.json").read_text())
    saved["runs"]["cpu/a"]["commit"] = "0" * 40
    (root / "agreement.json").write_text(json.dumps(saved))
    (root / "elsewhere.json").write_text((root / "transforms.json").read_text())
    because = {entry.figures.split(".")[0]: entry.because for entry in figures.old(root, root)}
    assert "is not in this history" in because["agreement"]
    assert "add it to benchmarks/figures.py" in because["elsewhere"]


def test_what_each_committed_result_and_each_fault_measures_is_declared():
    for path in (*report.RESULTS.glob("*.json"), *report.RESULTS.glob("tables/*.json")):
        if path.stem != "faults":
            assert figures.measured(path.stem), path.name
    for name, row in ROWS.items():
        assert figures.measured("faults", f"cpu/{name}") and all(
            (figures.ROOT / file).exists() for file in row.files
        )
