"""Runs are found and summed up from what they left, also from what a stranger or a crash left."""

import json
import os

import pytest

from ksim_rl.runs import listing, record
from ksim_rl.runs.csv_table import CsvTable


def make_run(
    folder, *, task="cartpole_balance", status="done", returns=(1.0, 2.0), seed=1, evaluation=None
):
    """Write what a run leaves."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(
        f"num_envs: 4\nseed: {seed}\ntask_name: {task}\ntask: {{}}\n"
    )
    session = {
        "began": f"2030-01-0{seed} 00:00:00",
        "command": "ksim-rl train",
        "status": status,
        "why": "w",
    }
    (folder / record.RECORD).write_text(json.dumps({"sessions": [session]}))
    table = CsvTable(folder / "metrics.csv")
    for step, value in enumerate(returns, 1):
        figures = {"iteration": step, "seconds": 10.0 * step, "episode/return": value}
        table.log_metrics(figures | {"throughput/env_states_per_s": 100.0 * step}, step * 64)
    if evaluation is not None:
        table.log_metrics({"evaluation/return_mean": evaluation}, len(returns) * 64)
    return folder


def test_a_run_in_figures(tmp_path):
    run = make_run(tmp_path / "a", evaluation=7.5)
    found = listing.summarize(run)
    assert (found.task, found.status, found.began) == (
        "cartpole_balance",
        "done",
        "2030-01-01 00:00:00",
    )
    assert (found.iteration, found.env_states, found.seconds) == (2, 128, 20.0)
    assert (found.evaluation, found.episodes, found.speed) == (7.5, 2.0, 150.0)
    cells = listing.line(found, name="a")
    assert cells == [
        "a",
        "cartpole_balance",
        "done",
        "2030-01-01 00:00:00",
        "2",
        "128",
        "0:00:20",
        "7.5",
        "2",
        "150",
    ]


def test_runs_are_found_at_any_depth_and_links_are_not_followed(tmp_path):
    runs = [make_run(tmp_path / "runs" / name) for name in ("b", "multirun/x/1_seed=2")]
    make_run(tmp_path / "elsewhere")
    (tmp_path / "runs" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "runs" / "empty").mkdir()
    assert listing.find(tmp_path / "runs") == runs and listing.find(runs[0]) == [runs[0]]
    with pytest.raises(ValueError, match="no such folder"):
        listing.find(tmp_path / "nowhere")


def test_a_run_that_has_just_begun_has_no_figures(tmp_path):
    run = make_run(tmp_path / "a", returns=())
    (run / "metrics.csv").unlink(missing_ok=True)
    assert listing.line(listing.summarize(run), name="a")[4:] == ["-"] * 6


def test_what_cannot_be_read_is_said_and_hides_no_other_run(tmp_path):
    run = make_run(tmp_path / "a")
    (run / "metrics.csv").unlink()
    os.mkfifo(run / "metrics.csv")
    found = listing.summarize(run)
    assert (
        "metrics.csv: cannot be read: it is no regular file" in found.why
        and found.task == "cartpole_balance"
    )


@pytest.mark.parametrize("value", ["nan", "inf", "words", ""])
def test_values_that_are_no_numbers_are_passed_over(tmp_path, value):
    run = make_run(tmp_path / "a", returns=(1.0,))
    (run / "metrics.csv").write_text(f"env_states,iteration,episode/return\n64,1,{value}\n")
    found = listing.summarize(run)
    assert (found.iteration, found.episodes, found.speed) == (1, None, None)
