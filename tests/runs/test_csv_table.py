"""One table with all metrics of a run."""

import csv
import tracemalloc

import pytest

from ksim_rl.trainers.loggers import CsvTable


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "metrics.csv"


def test_rows_are_on_disk_as_soon_as_they_are_logged(path):
    table = CsvTable(path)
    for step in (100, 200):
        table.log_metrics({"loss": step / 3}, step)
        assert rows(path)[-1] == {"env_states": str(step), "loss": f"{step / 3:.9g}"}


def test_a_new_metric_becomes_a_column_and_earlier_cells_are_empty(path):
    table = CsvTable(path)
    table.log_metrics({"loss": 1.0}, 100)
    table.log_metrics({"loss": 2.0, "evaluation": 5.0}, 200)
    assert [row["evaluation"] for row in rows(path)] == ["", "5"]


def test_metrics_of_one_step_share_a_row(path):
    table = CsvTable(path)
    table.log_metrics({"loss": 1.0}, 100)
    table.log_metrics({"evaluation": 5.0}, 100)
    assert rows(path) == [{"env_states": "100", "loss": "1", "evaluation": "5"}]


def test_a_resumed_run_has_each_iteration_once(path):
    table = CsvTable(path)
    for step in (100, 200, 300, 400):
        table.log_metrics({"loss": 1.0}, step)
    resumed = CsvTable(path)
    resumed.log_metrics({"loss": 2.0}, 300)
    resumed.log_metrics({"loss": 3.0}, 400)
    assert [(row["env_states"], row["loss"]) for row in rows(path)] == [
        ("100", "1"),
        ("200", "1"),
        ("300", "2"),
        ("400", "3"),
    ]


def test_only_the_table_is_left(path):
    CsvTable(path).log_metrics({"loss": 1.0}, 100)
    assert [entry.name for entry in path.parent.iterdir()] == ["metrics.csv"]


def test_a_row_that_could_not_be_written_is_there_after_the_next_one(path, monkeypatch):
    table = CsvTable(path)
    table.log_metrics({"loss": 1.0}, 100)
    with monkeypatch.context() as full:
        full.setattr(table, "_writer", lambda file: file.write("20") and 1 / 0)
        with pytest.raises(ZeroDivisionError):
            table.log_metrics({"loss": 2.0}, 200)
    table.log_metrics({"loss": 3.0}, 300)
    assert [(row["env_states"], row["loss"]) for row in rows(path)] == [
        ("100", "1"),
        ("200", "2"),
        ("300", "3"),
    ]


def test_a_row_that_a_crash_cut_off_is_left_out(path):
    CsvTable(path).log_metrics({"loss": 1.0}, 100)
    with open(path, "a") as file:
        file.write("20")
    CsvTable(path).log_metrics({"loss": 3.0}, 300)
    assert [row["env_states"] for row in rows(path)] == ["100", "300"]


def test_the_table_is_never_in_memory(path):
    table = CsvTable(path)
    table.log_metrics({"loss": 1.0}, 0)
    with open(path, "a") as file:
        file.writelines(f"{step},0.123456789\n" for step in range(1, 50_000))
    tracemalloc.start()
    try:
        table.log_metrics({"loss": 1.0}, 60_000)
        table.log_metrics({"a new column": 2.0}, 60_000)
        CsvTable(path).log_metrics({"loss": 1.0}, 60_001)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(rows(path)) == 50_002
    assert peak < path.stat().st_size / 3


def test_a_row_is_completed_without_a_copy_of_the_table(path):
    table = CsvTable(path)
    table.log_metrics({"loss": 1.0, "evaluation": 4.0}, 100)
    file = path.stat().st_ino
    table.log_metrics({"loss": 1.25}, 200)
    table.log_metrics({"evaluation": 5.0}, 200)
    table.log_metrics({"loss": 2.0}, 200)
    table.log_metrics({"loss": 3.0}, 300)
    assert path.stat().st_ino == file
    assert [tuple(row.values()) for row in rows(path)] == [
        ("100", "1", "4"),
        ("200", "2", "5"),
        ("300", "3", ""),
    ]


def test_a_row_that_a_crash_cut_off_in_its_last_number_is_left_out(path):
    CsvTable(path).log_metrics({"loss": 1.0}, 100)
    with open(path, "a") as file:
        file.write("200,1.2")
    CsvTable(path).log_metrics({"loss": 3.0}, 300)
    assert [row["env_states"] for row in rows(path)] == ["100", "300"]
