import json
import subprocess
from pathlib import Path

import torch

from benchmarks import report

CPU = torch.device("cpu")


def write(folder: Path, figures: dict[str, float], **measured) -> dict:
    path = report.write(
        "speed", figures=figures, device=CPU, module="benchmarks.speed", folder=folder, **measured
    )
    return json.loads(path.read_text())


def test_a_run_merges_its_figures_in_and_drops_no_other(tmp_path: Path):
    write(tmp_path, {"h200/a/ms": 1.0, "cpu/a/ms": 2.0}, curves={"a": [1, 2]}, note="first")
    saved = write(tmp_path, {"cpu/a/ms": 3.0, "cpu/b/ms": 4.0}, curves={"b": [3]}, note="second")
    assert saved["figures"] == {"h200/a/ms": 1.0, "cpu/a/ms": 3.0, "cpu/b/ms": 4.0}
    assert saved["curves"] == {"a": [1, 2], "b": [3]}
    assert saved["note"] == "second"
    assert [path.name for path in tmp_path.iterdir()] == ["speed.json"]


def test_reports_of_several_processes_merge_and_the_later_run_wins(tmp_path: Path):
    one, other, folder = tmp_path / "one", tmp_path / "other", tmp_path / "all"
    folder.mkdir()
    for where, date, figures in (
        (folder, "2026-01-01", {"cpu/a/ms": 1.0, "cpu/c/ms": 5.0}),
        (other, "2026-01-03", {"cpu/a/ms": 3.0}),
        (one, "2026-01-02", {"cpu/a/ms": 2.0, "cpu/b/ms": 4.0}),
    ):
        saved = write(where, figures, notes=dict.fromkeys(figures, date))
        (where / "speed.json").write_text(
            json.dumps({**saved, "date": date, "versions": {date: "1"}})
        )
    merged = json.loads(report.merge("speed", [one, other], folder=folder).read_text())
    assert merged["figures"] == {"cpu/a/ms": 3.0, "cpu/b/ms": 4.0, "cpu/c/ms": 5.0}
    assert merged["notes"] == {
        "cpu/a/ms": "2026-01-03",
        "cpu/b/ms": "2026-01-02",
        "cpu/c/ms": "2026-01-01",
    }
    assert set(merged["runs"]) == {"cpu/a", "cpu/b", "cpu/c"}
    assert (merged["date"], merged["versions"]) == ("2026-01-03", {"2026-01-03": "1"})


def test_a_report_says_what_ran_where_and_with_what(tmp_path: Path):
    saved = write(tmp_path, {"cpu/a/ms": 2.0})
    assert saved["command"].startswith("python -m benchmarks.speed")
    assert saved["commit"]
    assert saved["date"].endswith("+00:00")
    assert "cores" in saved["device"]
    assert (
        saved["versions"]["torch"] == torch.__version__.split("+")[0]
        or "torch" in saved["versions"]
    )
    assert "not installed" not in (saved["versions"]["mujoco"], saved["versions"]["warp-lang"])


def test_a_tree_is_dirty_by_its_code_and_not_by_what_benchmarks_write(tmp_path: Path, monkeypatch):
    for name in (
        "benchmarks/report.py",
        "benchmarks/results/speed.json",
        "docs/speed.md",
        "package/code.py",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), ("add", "."), (*who, "commit", "-qm", "all")):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    monkeypatch.setattr(report, "__file__", str(tmp_path / "benchmarks" / "report.py"))
    clean = report.commit()
    for name in ("benchmarks/results/speed.json", "benchmarks/results/new.json", "docs/speed.md"):
        (tmp_path / name).write_text("1")
    assert report.commit() == clean and len(clean) == 40
    (tmp_path / "package" / "code.py").write_text("1")
    assert report.commit() == f"{clean}-dirty"


def test_figures_of_another_module_keep_their_own_run(tmp_path: Path):
    write(tmp_path, {"cpu/a/ms": 2.0})
    path = report.write(
        "speed",
        figures={"cpu/a/cold_s": 9.0},
        device=CPU,
        module="benchmarks.start",
        folder=tmp_path,
    )
    runs = json.loads(path.read_text())["runs"]
    assert {group: run["command"].split()[2] for group, run in runs.items()} == {
        "cpu/a": "benchmarks.speed",
        "cpu/a/start": "benchmarks.start",
    }


def test_labels_are_short(monkeypatch):
    assert report.device_label(CPU) == "cpu"
    for name, label in (
        ("NVIDIA H200", "h200"),
        ("NVIDIA A100-SXM4-80GB", "a100"),
        ("Tesla T4", "t4"),
    ):
        monkeypatch.setattr(torch.cuda, "get_device_name", lambda device, name=name: name)
        assert report.device_label(torch.device("cuda:0")) == label
