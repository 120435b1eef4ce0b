"""One table with all metrics of a run."""

import csv

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


def test_memory_holds_no_more_than_the_last_row(path):
    table = CsvTable(path)
    for step in range(100, 1000, 100):
        table.log_metrics({"loss": 1.0}, step)
    assert len(table._rows) == 1 and len(rows(path)) == 9


def test_a_row_that_a_crash_cut_off_in_its_last_number_is_left_out(path):
    CsvTable(path).log_metrics({"loss": 1.0}, 100)
    with open(path, "a") as file:
        file.write("200,1.2")
    CsvTable(path).log_metrics({"loss": 3.0}, 300)
    assert [row["env_states"] for row in rows(path)] == ["100", "300"]
