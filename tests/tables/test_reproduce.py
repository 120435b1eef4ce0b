"""`ksim-rl reproduce` runs what is missing, keeps what is there, and says what is reached."""

import json
import subprocess
import sys
from dataclasses import dataclass, replace

import pytest
import torch

from benchmarks.report import RESULTS
from ksim_rl.cli.main import main
from ksim_rl.config import plugins
from ksim_rl.envs import MetricTerm
from ksim_rl.envs.term import Reduction
from ksim_rl.tables import measure as measuring
from ksim_rl.tables import reproduce as reproduce_command
from ksim_rl.tables import runner
from ksim_rl.tables.measure import RowCfgs, measure, run_cfg, settings
from ksim_rl.tables.table import load, shipped

TABLE = """
title: Two poles
means: {mean_all: {without: [Other], at_least: {ppo: 150}}}
groups:
  ppo:
    objective: ppo
    env_states: 1.0e+6
    seeds: [1, 2]
    against: PPO
    rows:
      Balance: {task: cartpole_balance, published: {PPO: 100}}
      Swingup: {task: cartpole_swingup, published: {PPO: 250, SAC: 300}}
      Other: {task: reacher}
"""
RETURNS = {"ppo/Balance": 100.0, "ppo/Swingup": 200.0, "ppo/Other": 7.0}


@pytest.fixture
def reproduce(monkeypatch, tmp_path):
    """Run the command where each job is a process that writes a result, or fails; return code, jobs and table."""
    started, processes = [], []

    def start(self, job, gpu, log):
        log.close()
        started.append(job)
        row = self.table.rows[job[0]]
        result = {
            "settings": str(row.overrides),
            "commit": "abc",
            "date": f"2026-01-0{job[1]}",
            "device": "CPU",
            "versions": {},
            "evaluation": {"return_mean": RETURNS[job[0]] + job[1]},
            "falls": 0.0,
            "means": {"episode/length": 0.5 + job[1]},
            "seconds_to_levels": None,
            "env_states": 1e6,
            "seconds": 5.0,
            "seconds_before": 1.0,
            "curve": [],
        }
        path = self.folder / job[0] / f"seed_{job[1]}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        self._log(job).parent.mkdir(parents=True, exist_ok=True)
        self._log(job).write_text("first\nno such cube")
        code = "import sys; open(sys.argv[1], 'w').write(sys.argv[2]); sys.exit(int(sys.argv[3]))"
        fails = str(int(job == failing.get("job")))
        written = "{" if fails == "1" else json.dumps(result)
        target = str(path.with_suffix(".failed" if fails == "1" else ".json"))
        processes.append(subprocess.Popen([sys.executable, "-c", code, target, written, fails]))
        reproduce.most_at_once = max(
            reproduce.most_at_once, sum(process.poll() is None for process in processes)
        )
        return processes[-1]

    failing = {}
    monkeypatch.setattr(runner.Runs, "_start", start)
    # Composing a run's config takes its time, and has tests of its own below.
    monkeypatch.setattr(
        runner.RowCfgs, "settings", lambda self, name: str(self.rows[name].overrides)
    )
    monkeypatch.setattr(runner.RowCfgs, "read_by", lambda self, name: ())
    monkeypatch.setattr(reproduce_command, "run_cfg", lambda row, seed, **options: None)
    path = tmp_path / "poles.yaml"

    def reproduce(*words, text=TABLE, fail=None):
        path.write_text(text)
        started.clear()
        reproduce.most_at_once = 0
        failing["job"] = fail
        arguments = [
            str(path),
            "--output",
            str(tmp_path / "out"),
            "--runs",
            str(tmp_path / "runs"),
            *words,
        ]
        with pytest.raises(SystemExit) as ended:
            main(["reproduce", *arguments])
        written = tmp_path / "out" / "poles.json"
        table = json.loads(written.read_text()) if written.exists() else {}
        return ended.value.code, list(started), table

    reproduce.folder = tmp_path / "out"
    return reproduce


def test_what_is_missing_is_run_seed_by_seed_and_what_is_there_stays(reproduce):
    code, started, table = reproduce("--seeds", "1", "--rows", "ppo/(Balance|Swingup)")
    assert started == [("ppo/Balance", 1), ("ppo/Swingup", 1)]
    assert table["figures"]["poles/ppo/Balance"] == 101.0 and table["seeds"] == [1]
    code, started, table = reproduce()
    assert started == [("ppo/Other", 1), ("ppo/Balance", 2), ("ppo/Swingup", 2), ("ppo/Other", 2)]
    assert table["figures"] == {
        "poles/ppo/Balance": 101.5,
        "poles/ppo/Swingup": 201.5,
        "poles/ppo/Other": 8.5,
        "poles/ppo/mean_all": 151.5,
        "poles/best/mean_all": 151.5,
    }
    assert table["seeds"] == [1, 2] and table["commit"] == "abc"
    assert table["command"] == f"ksim-rl reproduce {reproduce.folder.parent / 'poles.yaml'}"
    assert {name: row["reached"] for name, row in table["rows"].items()} == {
        "ppo/Balance": True,
        "ppo/Swingup": False,
        "ppo/Other": None,
    }
    assert code == 1, "a row misses its goal"
    assert reproduce("--rows", "ppo/Balance")[:2] == (0, [])
    page = (reproduce.folder / "poles.md").read_text()
    assert "| Swingup | 250.0 | 300.0 | 202 ± 1 | 2 | 1.0 M | 5 + 1 | no |" in page
    assert "mean_all: 152, at least 150 asked" in page
    assert (reproduce.folder / "poles.png").stat().st_size > 10_000


def test_results_of_other_settings_do_not_count(reproduce):
    reproduce("--rows", "ppo/Balance")
    changed = TABLE.replace(
        "task: cartpole_balance,", "task: cartpole_balance, overrides: [objective.gamma=0.9],"
    )
    code, started, _ = reproduce("--rows", "ppo/Balance", text=changed)
    assert started == [("ppo/Balance", 1), ("ppo/Balance", 2)] and code == 0


def test_a_run_that_fails_is_said_and_costs_its_row_only(reproduce, capsys):
    code, _, table = reproduce("--rows", "ppo/(Balance|Other)", fail=("ppo/Balance", 2))
    assert code == 1 and list(table["figures"]) == ["poles/ppo/Other"]
    said = capsys.readouterr().out
    assert "ppo/Balance, seed 2: exit code 1, no such cube" in said and "1 runs are missing" in said


def test_what_another_process_does_is_waited_for_and_not_done_again(reproduce, monkeypatch, capsys):
    reproduce("--rows", "ppo/Balance", "--seeds", "1")
    result = reproduce.folder / "poles" / "ppo" / "Balance" / "seed_1.json"
    done = result.read_text()
    result.unlink()
    looks = []

    def is_locked(folder):
        looks.append(folder.name)
        if looks.count("seed_1") == 3:
            result.write_text(done)  # the other is done
        return folder.name == "seed_1" and looks.count("seed_1") < 3

    monkeypatch.setattr(runner.run_lock, "is_locked", is_locked)
    capsys.readouterr()
    code, started, table = reproduce("--rows", "ppo/Balance")
    assert (code, started) == (0, [("ppo/Balance", 2)])
    assert table["figures"]["poles/ppo/Balance"] == 101.5
    assert "ppo/Balance, seed 1: done by another process" in capsys.readouterr().out


def test_a_row_whose_source_has_failed_does_not_begin(reproduce, capsys):
    text = TABLE.replace("{task: reacher}", "{task: reacher, begins_from: ppo/Balance}")
    options = {"text": text, "fail": ("ppo/Balance", 1)}
    only_one = ("--seeds", "1", "--rows", "ppo/(Balance|Other)")
    code, started, _ = reproduce(*only_one, **options)
    assert (code, started) == (1, [("ppo/Balance", 1)])
    said = "ppo/Other, seed 1: row 'ppo/Balance', which it learns from, has no result"
    assert said in capsys.readouterr().out
    # Nor where its source is not run at all, as another one might have its folder now.
    assert reproduce(*only_one[:3], "ppo/Other", text=text)[:2] == (1, [])


def test_a_job_that_another_process_took_first_is_no_failure(reproduce, monkeypatch):
    looks = []

    def is_locked(folder):
        looks.append(folder)
        return len(looks) == 2  # once the own process has failed

    monkeypatch.setattr(runner.run_lock, "is_locked", is_locked)
    code, started, _ = reproduce("--rows", "ppo/Balance", "--seeds", "1", fail=("ppo/Balance", 1))
    # It fails again, and no other process runs it.
    assert started == [("ppo/Balance", 1)] * 2 and code == 1


def test_a_job_belongs_to_who_has_its_log_until_that_process_ends(reproduce, tmp_path):
    reproduce("--rows", "ppo/Balance", "--seeds", "1")
    job = ("ppo/Balance", 1)
    path = str(reproduce.folder.parent / "poles.yaml")
    first, second = (
        runner.Runs(load(path), tmp_path / "new", tmp_path / "new_runs", smoke=False)
        for _ in range(2)
    )
    taken, log = first._next([job], [], set(), print)
    assert taken == job
    sleeper = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, stdout=log)
    log.close()
    elsewhere = set()
    assert second._next([job], [], elsewhere, print) is None and elsewhere == {job}
    sleeper.communicate(b"\n")
    assert second._next([job], [], elsewhere, print)[0] == job


def test_what_another_process_has_done_meanwhile_is_kept(reproduce, tmp_path, capsys):
    reproduce("--rows", "ppo/Balance", "--seeds", "1")
    path = str(reproduce.folder.parent / "poles.yaml")
    runs = runner.Runs(
        load(path), reproduce.folder / "poles", tmp_path / "runs" / "poles", smoke=False
    )
    assert runs._next([("ppo/Balance", 1)], [], set(), print) is None
    assert "ppo/Balance, seed 1: done by another process" in capsys.readouterr().out


def test_without_time_nothing_runs_and_the_table_is_of_what_is_there(reproduce):
    reproduce("--rows", "ppo/Balance")
    code, started, table = reproduce("--minutes", "0")
    assert (code, started, list(table["figures"])) == (1, [], ["poles/ppo/Balance"])


def test_runs_share_a_gpu_where_no_row_measures_seconds(reproduce, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,2")
    assert runner.gpus_for("cuda", per_gpu=2) == ["0", "2", "0", "2"]
    assert runner.gpus_for("cpu", per_gpu=2) == [""]
    monkeypatch.setattr(reproduce_command, "gpus_for", lambda device, per_gpu: ["0"] * per_gpu)
    reproduce("--rows", "ppo/Balance")
    assert reproduce.most_at_once == 1
    reproduce("--rows", "ppo/Swingup", "--per-gpu", "2")
    assert reproduce.most_at_once == 2
    with pytest.raises(ValueError, match="--per-gpu=0"):
        reproduce_command.reproduce([str(reproduce.folder.parent / "poles.yaml"), "--per-gpu", "0"])
    timed = TABLE.replace(
        "Other: {task: reacher}",
        "Other: {task: reacher, measure: seconds, levels: {episode/return: 5}}",
    )
    with_seconds = TABLE.replace(
        "Other: {task: reacher}", "Other: {task: reacher, figures: {seconds: seconds}}"
    )
    for text in (timed, with_seconds):
        (reproduce.folder.parent / "poles.yaml").write_text(text)
        with pytest.raises(ValueError, match="ppo/Other measures seconds"):
            reproduce_command.reproduce(
                [str(reproduce.folder.parent / "poles.yaml"), "--per-gpu", "2"]
            )


def test_a_row_whose_levels_no_seed_reaches_is_in_the_table(reproduce):
    row = "Other: {task: reacher, measure: seconds, levels: {episode/return: 5}, within_s: 9}"
    text = TABLE.replace("Other: {task: reacher}", row)
    code, _, table = reproduce("--rows", "ppo/Other", "--seeds", "1", text=text)
    assert code == 1 and table["figures"] == {"poles/ppo/Other/falls": 0.0}
    assert "not reached, falls 0.0 %" in (reproduce.folder / "poles.md").read_text()
    assert not (reproduce.folder / "poles.png").exists(), "a picture of nothing"


def test_what_training_ended_with_stands_beside_the_return_for_the_worst_seed(reproduce):
    text = TABLE.replace(
        "Other: {task: reacher}", "Other: {task: reacher, levels: {episode/length: 2}}"
    )
    assert reproduce("--rows", "ppo/Other", text=text)[0] == 1
    assert (
        "| 8 ± 1, length 1.50 | 2 | 1.0 M | 5 + 1 | no |"
        in (reproduce.folder / "poles.md").read_text()
    )
    assert reproduce("--rows", "ppo/Other", text=text.replace("length: 2", "length: 1"))[0] == 0


def test_unknown_rows_and_seeds_are_refused(reproduce, capsys):
    assert reproduce("--rows", "ppo/Balanc")[:2] == (2, [])
    assert "'ppo/Balance'" in capsys.readouterr().err
    assert reproduce("--seeds", "11")[:2] == (2, [])
    assert "none of [1, 2]" in capsys.readouterr().err


def test_settings_differ_by_everything_but_the_seed():
    row = load("velocity").rows["ppo/go1"]
    first = settings(row, run_cfg(row, 1, device="cpu"))
    assert first == settings(row, run_cfg(row, 2, device="cpu"))
    assert first != settings(row, run_cfg(row, 1, device="cpu", smoke=True))


TRIALS = sorted(map(str, (RESULTS.parent / "tables").glob("*.yaml")))


# The tables with the most rows; each row builds its config.
LONG_TABLES = ("dm_control", "tasks")


def tables_with_results():
    found = []
    for table in [*shipped(), *TRIALS]:
        marks = [pytest.mark.full] if table in LONG_TABLES else []
        found.append(pytest.param(table, marks=marks))
    return found


@pytest.mark.parametrize("table", tables_with_results())
def test_committed_results_are_of_the_settings_that_rows_have_now(table):
    table = load(table)
    cfgs = RowCfgs(table.rows)
    for name in table.rows:
        # Rows without results are composed by `test_table`.
        for path in (RESULTS / "tables" / table.name / name).glob("seed_*.json"):
            assert json.loads(path.read_text())["settings"] == cfgs.settings(name), path


def test_a_seed_is_trained_and_its_final_policy_judged(tmp_path):
    path = tmp_path / "one.yaml"
    path.write_text(TABLE)
    row = load(str(path)).rows["ppo/Balance"]
    found = measure(row, 1, tmp_path / "run", device="cpu", smoke=True)
    assert found["settings"] == settings(row, run_cfg(row, 1, device="cpu", smoke=True))
    assert found["evaluation"]["episodes"] == 8 and found["env_states"] == 2 * 64
    assert 0.0 < found["evaluation"]["return_mean"] <= 40.0
    assert 0.0 <= found["falls"] <= 1.0
    assert found["seconds"] == pytest.approx(found["curve"][-1]["seconds"], abs=0.01)
    assert found["seconds_before"] > 0.0 and len(found["commit"]) >= 7


@pytest.mark.full
def test_the_final_policy_walks_the_course_of_its_row(tmp_path):
    row = replace(load("rough").rows["go1"], overrides=("task.sim.engine=c",))
    found = measure(row, 1, tmp_path / "run", device="cpu", smoke=True)
    course = found["course"]
    assert len(course["success_by_level"]) == 8 and course["level"] == 9
    # Nobody gets 3.2 m away in the 0.4 s of a smoke test.
    assert (course["fell"], course["lost"]) == (0.0, [])
    assert found["means"]["evaluation/course_least"] == 0.0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"course_level": 9}, "course_level: .*needs a TerrainGrid"),
        ({"course_least": 0.9}, "course_least=0.9: .*give course_level"),
    ],
)
def test_a_course_of_a_task_on_flat_ground_is_refused_before_training(tmp_path, fields, message):
    path = tmp_path / "one.yaml"
    path.write_text(TABLE)
    row = load(str(path)).rows["ppo/Balance"]
    with pytest.raises(ValueError, match=message):
        run_cfg(replace(row, **fields), 1, device="cpu")


@dataclass(frozen=True, kw_only=True)
class Steps(MetricTerm):
    """How many steps the episode has made."""

    reduce: Reduction = "last"

    def __call__(self, view):
        return view.episode_step_E.to(torch.float32)


def test_means_are_of_the_end_of_training_and_of_the_episodes_of_the_evaluation(
    monkeypatch, tmp_path
):
    def with_steps(row, seed, **options):
        cfg = run_cfg(row, seed, **options)
        return replace(cfg, task=replace(cfg.task, metrics={"steps": Steps()}))

    monkeypatch.setattr(measuring, "run_cfg", with_steps)
    path = tmp_path / "one.yaml"
    path.write_text(
        TABLE.replace("Swingup: {", "Swingup: {levels: {rollout/reward: 0, episode/none: 0}, ")
    )
    row = load(str(path)).rows["ppo/Swingup"]
    found = measure(row, 1, tmp_path / "run", device="cpu", smoke=True)
    logged = [point["rollout/reward"] for point in found["curve"]]
    assert len(logged) == 2 and found["means"] == {
        "rollout/reward": pytest.approx(sum(logged) / 2),
        "evaluation/metric/steps": found["evaluation"]["length_mean"],
    }


def test_a_row_may_name_the_task_of_a_plug_in(monkeypatch, tmp_path):
    (tmp_path / "poles_of_mine.py").write_text(
        "import dataclasses\n"
        "from ksim_rl import envs\n"
        "MINE = dataclasses.replace(envs.task('cartpole_balance'), name='balance_of_mine', solved_at=None)\n"
    )
    (tmp_path / "mine.yaml").write_text(TABLE.replace("task: reacher", "task: balance_of_mine"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("KSIM_RL_PLUGINS", "poles_of_mine")
    # What is named here ends with the test: other tests ask for all tasks.
    monkeypatch.setattr(plugins, "_named", [])
    monkeypatch.setattr(
        measuring, "measure", lambda row, *_, **__: {"task": run_cfg(row, 1).task_name}
    )
    result = tmp_path / "out" / "seed_1.json"
    measuring.main(str(tmp_path / "mine.yaml"), "ppo/Other", "1", str(result), str(tmp_path), "cpu")
    assert json.loads(result.read_text()) == {"task": "balance_of_mine"}


@pytest.mark.full
@pytest.mark.parametrize(
    ("table", "rows"),
    [
        ("dm_control", "(ppo|fast_sac)/(CartpoleSwingup|ReacherHard)"),
        ("velocity", ".*"),
        ("humanoids", ".*"),
        ("manipulation", ".*"),
        ("tasks", "(arm|motion|get_up)/.*"),
    ],
)
def test_the_shipped_tables_run_for_two_iterations(table, rows, tmp_path, capsys):
    words = [table, "--rows", rows, "--seeds", "1", "--smoke", "--device", "cpu"]
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "reproduce",
                *words,
                "--output",
                str(tmp_path / "out"),
                "--runs",
                str(tmp_path / "runs"),
            ]
        )
    said = capsys.readouterr().out
    if "menagerie model" in said or "ksim_rl[playground]" in said:
        pytest.skip(said)
    assert ended.value.code == 0, said
