"""`ksim-rl runs` and `ksim-rl compare`."""

import pytest

from ksim_rl.cli import main
from tests.runs.test_listing import make_run


def run(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main.main(list(arguments))
    return stopped.value.code


@pytest.fixture
def work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs" / "cartpole_balance" / "a", returns=(9.0,), seed=1)
    make_run(
        tmp_path / "runs" / "pendulum_swingup" / "b",
        returns=(3.0, 4.0),
        seed=2,
        task="pendulum_swingup",
    )
    return tmp_path


def test_runs_are_listed_by_age_with_return_and_speed(work, capsys):
    assert run("runs") == 0
    head, first, second = capsys.readouterr().out.splitlines()
    assert head.split()[0] == "run" and "env states/s" in head
    assert first.split()[0] == "runs/cartpole_balance/a" and second.split()[-2:] == ["4", "150"]


def test_they_are_sorted_and_chosen(work, capsys):
    assert run("runs", "runs", "--sort", "speed") == 0
    assert [line.split()[-1] for line in capsys.readouterr().out.splitlines()[1:]] == ["100", "150"]
    assert run("runs", "--task", "pendulum_swingup") == 0
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_no_runs_are_said(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("runs") == 2 and "runs lie in runs/" in capsys.readouterr().err
    assert run("runs", ".") == 0 and capsys.readouterr().out == "no runs in .\n"


def test_runs_are_compared_in_a_table_and_a_picture(work, capsys):
    assert run("compare", "runs/cartpole_balance/a", "runs/pendulum_swingup/b") == 0
    output = capsys.readouterr().out
    assert output.splitlines()[0].split() == ["run", "a", "b"] and output.endswith("compare.png\n")
    assert any(
        line.split() == ["task_name", "cartpole_balance", "pendulum_swingup"]
        for line in output.splitlines()
    )
    assert (work / "compare.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["runs/cartpole_balance/a"], "name at least two runs"),
        (["runs", "runs"], "runs: expected a run folder"),
        (["a", "b", "--output", "a.txt"], "expected a file that ends in .png"),
    ],
)
def test_what_cannot_be_compared_is_one_line(work, capsys, arguments, message):
    assert run("compare", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (work / "compare.png").exists()
