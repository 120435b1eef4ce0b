"""`ksim-rl diagnose` reads run folders, finished or not, and its line stands at the end of a run."""

import json

import pytest

from ksim_rl.cli.main import main
from ksim_rl.diagnosis.diagnose import one_line
from tests.diagnosis.recorded_runs import recorded


def write_run(folder, curves, *, rows=None, tail=""):
    """Write a run folder with the curves; JSON is YAML."""
    names = list(curves.columns)
    table = [
        ",".join(
            "" if (cell := curves.columns[name][row]) is None else repr(cell) for name in names
        )
        for row in range(rows or curves.num_rows)
    ]
    folder.mkdir(parents=True)
    (folder / "metrics.csv").write_text("\n".join([",".join(names), *table, tail]))
    (folder / "config.yaml").write_text(json.dumps(curves.config))
    return folder


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(list(map(str, arguments)))
    return ended.value.code


def test_a_fault_is_explained_and_is_the_exit_code(tmp_path, capsys):
    folder = write_run(tmp_path / "run", recorded("faults")["std_at_floor"])
    assert run("diagnose", folder) == 1
    text = capsys.readouterr().out
    assert text.startswith("std at floor: policy/std is") and "What to change: " in text
    assert one_line(folder, "RUN").startswith("diagnosis: std at floor (")


def test_a_healthy_run_has_one_line(tmp_path, capsys):
    folder = write_run(tmp_path / "run", recorded("healthy")["cartpole_swingup_ppo_1"])
    assert run("diagnose", folder) == 0
    assert capsys.readouterr().out == "diagnosis: the metrics show no fault\n"


def test_a_run_that_was_killed_in_the_middle_of_a_row_is_read(tmp_path, capsys):
    folder = write_run(
        tmp_path / "run", recorded("faults")["std_at_floor"], rows=15, tail="123456,0.1"
    )
    (folder / "checkpoint" / "5").mkdir(parents=True)
    assert run("diagnose", folder / "checkpoint" / "5") == 1
    assert "std at floor" in capsys.readouterr().out


def test_too_few_rows_are_said(tmp_path, capsys):
    folder = write_run(tmp_path / "run", recorded("faults")["std_at_floor"], rows=4)
    assert run("diagnose", folder) == 0
    assert "4 rows of metrics, and it takes 10" in capsys.readouterr().out


def test_a_folder_without_metrics_is_refused_in_one_line(tmp_path, capsys):
    assert run("diagnose", tmp_path) == 2
    error = capsys.readouterr().err
    assert "metrics.csv" in error and "logger.csv=true" in error and error.count("\n") == 1
    assert one_line(tmp_path, "RUN").startswith("no diagnosis: ")


def test_a_damaged_table_is_refused(tmp_path, capsys):
    folder = write_run(tmp_path / "run", recorded("faults")["std_at_floor"])
    table = (folder / "metrics.csv").read_text().replace("\n", "\n" + "x", 1)
    (folder / "metrics.csv").write_text(table)
    assert run("diagnose", folder) == 2
    assert "damaged" in capsys.readouterr().err
