"""Rows of a table learn from rows above them: episodes are recorded, cloned, and a run goes on from the clone."""

import json
import math
import shutil
from dataclasses import dataclass, replace

import pytest

from ksim_rl import conf
from ksim_rl.data import OfflineCfg, read_episodes
from ksim_rl.runs.listing import CONFIG
from ksim_rl.tables import measure as measuring
from ksim_rl.tables import report
from ksim_rl.tables.inputs import Sources, clear_finished, write_finished
from ksim_rl.tables.lineage import EPISODES, depth_of, overrides_of, sources_of, with_sources
from ksim_rl.tables.measure import FIXED, RowCfgs, measure, run_cfg
from ksim_rl.tables.runner import Runs
from ksim_rl.tables.table import Row, load

TABLE = """
title: Two ways to a pole
groups:
  pole:
    task: cartpole_swingup
    objective: ppo
    measure: seconds
    levels: {episode/return: 9}
    overrides: [task.sim.engine=c]
    seeds: [1, 2]
    env_states: 1.0e+6
    rows:
      nothing: {recorded: 5}
      bc: {objective: bc, measure: return, levels: {evaluation/metric/up: 0.9}, learns_from: pole/nothing}
      online: {begins_from: pole/bc, saves_over: pole/nothing}
"""
ROWS = ("pole/nothing", "pole/bc", "pole/online")


def table(folder, old="", new=""):
    path = folder / "ours.yaml"
    path.write_text(TABLE.replace(old, new) if old else TABLE)
    return load(str(path))


def test_sources_come_first_and_are_found_by_seed(tmp_path):
    rows = table(tmp_path).rows
    assert [depth_of(rows, name) for name in ROWS] == [0, 1, 2]
    assert overrides_of(rows["pole/nothing"]) == []
    clone = rows["pole/bc"]
    sources = Sources(runs=tmp_path, fits=lambda name, result: True)
    found = tmp_path / "pole" / "nothing" / "seed_2"
    folders = sources.folders(clone, 2)
    assert folders == {"pole/nothing": found}
    assert overrides_of(clone) == [f"objective.episodes='pole/nothing/{EPISODES}'"]
    cfg = run_cfg(clone, 2)
    assert with_sources(cfg, clone, folders).objective.episodes == f"{found}/{EPISODES}"
    assert overrides_of(rows["pole/online"]) == ["checkpoint='pole/bc'"]
    other = replace(clone, objective="fast_sac")
    cfg = run_cfg(other, 1)
    assert cfg.data.offline == OfflineCfg(source=f"pole/nothing/{EPISODES}")
    cfg = with_sources(cfg, other, folders)
    assert cfg.data.offline == OfflineCfg(source=f"{found}/{EPISODES}")


@pytest.mark.full
def test_the_folders_of_sources_are_all_that_differs_from_what_a_row_stands_for(tmp_path):
    """The words of a command line with these folders compose the same config."""
    student = "{objective: distillation, measure: return, taught_by: pole/nothing}"
    rows = table(tmp_path, "      bc:", f"      student: {student}\n      bc:").rows
    folders = {name: tmp_path / name for name in rows}
    for name in ("pole/student", "pole/bc", "pole/online"):
        row = rows[name]
        named = run_cfg(row, 1)
        words = [f"task={row.task}", f"objective={row.objective}", "seed=1", *FIXED.split()]
        words += ["trainer.eval_episodes=128", *row.overrides]
        for word in overrides_of(row):
            for source in sources_of(row):
                word = word.replace(source, str(folders[source]))
            words.append(word)
        by_hand = conf.compose(words)
        found = with_sources(named, row, folders)
        assert found.to_tree() == by_hand.to_tree() | {"trainer": found.to_tree()["trainer"]}
        assert found != named


@dataclass(frozen=True)
class Composed:
    """Stands for the config of a row, which takes long to compose."""

    row: Row

    def to_tree(self):
        return {"overrides": list(self.row.overrides)}


def test_other_settings_of_a_row_are_others_of_all_that_learn_from_it(tmp_path, monkeypatch):
    composed = []

    def compose(row, seed, **options):
        composed.append(row)
        return Composed(row)

    monkeypatch.setattr(measuring, "run_cfg", compose)
    rows = table(tmp_path).rows
    changed = table(
        tmp_path, "{recorded: 5}", "{recorded: 5, overrides: [objective.gamma=0.9]}"
    ).rows
    ours = RowCfgs(rows)
    theirs = RowCfgs(changed)
    for name in ROWS:
        assert ours.settings(name) != theirs.settings(name)
    assert len(composed) == 2 * len(ROWS), "each row once, however many learn from it"
    # Nothing but the settings of their sources tells these apart.
    assert rows["pole/online"] == changed["pole/online"]


def test_a_row_waits_for_what_it_learns_from(tmp_path):
    runs = Runs(table(tmp_path), tmp_path / "results", tmp_path / "runs", smoke=True)
    source = ("pole/nothing", 1)
    clone = ("pole/bc", 1)
    assert runs._next([clone], [source], set(), print) is None
    for waiting, expected in (([clone, source], source), ([clone], clone)):
        job, log = runs._next(waiting, [], set(), print)
        log.close()
        assert job == expected


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("learns_from: pole/nothing", "learns_from: pole/nobody", "a row above it: pole/nothing$"),
        (
            "begins_from: pole/bc",
            "begins_from: pole/online",
            "a row above it: pole/nothing, pole/bc",
        ),
        ("{recorded: 5}", "{}", "keeps no episodes: set its `recorded`"),
        ("objective: bc,", "objective: bc, seeds: [1],", "it has the seeds"),
    ],
)
def test_rows_that_cannot_be_learned_from_are_refused(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=message):
        table(tmp_path, old, new)


def results_of(to_levels, **more):
    found = []
    for env_states in to_levels:
        found.append(
            {"env_states_to_levels": env_states, "seconds_to_levels": 1.0, "falls": 0.0, **more}
        )
    return found


def test_what_a_start_saves_counts_all_that_led_to_it(tmp_path):
    ours = table(tmp_path)
    results = {
        "pole/nothing": results_of([1000.0, 3000.0], recorded_env_states=50),
        "pole/bc": results_of(
            [None, None],
            env_states=100,
            means={"evaluation/metric/up": 0.75},
            evaluation={"return_mean": 1.0},
        ),
        "pole/online": results_of([200.0, 400.0]),
    }
    figures = report.figures_of(ours, results)
    assert figures["ours/pole/env_states_saved"] == 2000.0 - (300.0 + 100.0 + 50.0)
    assert figures["ours/pole/bc_success"] == 0.75
    # A seed that never gets there, of two, makes the median infinite.
    results["pole/online"][0]["env_states_to_levels"] = None
    assert "ours/pole/env_states_saved" not in report.figures_of(ours, results)
    assert "ours/pole/env_states_saved" not in report.figures_of(
        ours, {name: results[name] for name in ROWS if name != "pole/bc"}
    )


def test_a_student_is_compared_with_its_teacher_seed_by_seed(tmp_path):
    student = "{objective: distillation, measure: return, taught_by: pole/nothing}"
    ours = table(tmp_path, "      bc:", f"      student: {student}\n      bc:")
    row = ours.rows["pole/student"]
    assert sources_of(row) == ["pole/nothing"] and depth_of(ours.rows, "pole/student") == 1
    assert overrides_of(row) == ["objective.teacher='pole/nothing'"]
    shown = {"evaluation": {"return_mean": 1.0}, "means": {}}
    teacher = results_of([1.0, 1.0], **shown)
    learned = results_of([1.0, 1.0], **shown)
    results = {"pole/nothing": teacher, "pole/student": learned}
    share = "ours/pole/student/share_of_teacher"
    assert share not in report.figures_of(ours, results)
    # Half of all robots arrive with a teacher; of the students' 0.4 and 0.3.
    for own in teacher:
        own["course"] = {"success": 0.5}
    learned[0]["course"] = {"success": 0.4}
    learned[1]["course"] = {"success": 0.3}
    assert report.figures_of(ours, results)[share] == 0.6
    teacher[1]["course"] = {"success": 0.0}
    assert share not in report.figures_of(ours, results)


RESULT = {"settings": "now", "files": {}, "commit": "abc", "date": "2026-01-01 10:00:00"}


@pytest.fixture
def teacher(tmp_path):
    """The finished run of pole/nothing with seed 1, and its result; returns where both lie."""
    folder = tmp_path / "runs" / "pole" / "nothing" / "seed_1"
    folder.mkdir(parents=True)
    session = {"began": RESULT["date"], "command": "", "status": "done"}
    (folder / "run.json").write_text(json.dumps({"sessions": [session]}))
    write_finished(folder, RESULT, 1)
    result = tmp_path / "results" / "pole" / "nothing" / "seed_1.json"
    result.parent.mkdir(parents=True)
    result.write_text(json.dumps({**RESULT, "falls": 0.0}))
    return folder, result


def is_asked(tmp_path, settings="now"):
    """Ask for the sources of the clone with seed 1, where rows have these settings."""
    sources = Sources(
        runs=tmp_path / "runs",
        fits=lambda name, result: result["settings"] == settings,
        results=tmp_path / "results",
    )
    return sources.of(table(tmp_path).rows["pole/bc"], 1)


def test_a_row_learns_from_the_finished_run_that_its_source_counts_with(tmp_path, teacher):
    assert is_asked(tmp_path) == {"pole/nothing": {"seed": 1, **RESULT}}
    folder, result = teacher
    # As on a machine that has trained and not yet written.
    result.unlink()
    assert is_asked(tmp_path) == {"pole/nothing": {"seed": 1, **RESULT}}


def write_another_thing(folder, result):
    (folder / "row.json").write_text("[1, 2]")


def begin_anew(folder, result):
    clear_finished(folder)


def take_another_seeds(folder, result):
    write_finished(folder, RESULT, 2)


def go_on_by_hand(folder, result):
    sessions = json.loads((folder / "run.json").read_text())["sessions"]
    sessions.append({"began": "2026-01-02 10:00:00", "command": "", "status": "done"})
    (folder / "run.json").write_text(json.dumps({"sessions": sessions}))


def train_elsewhere(folder, result):
    result.write_text(json.dumps({**RESULT, "commit": "abd"}))


def leave_an_empty_folder(folder, result):
    shutil.rmtree(folder)
    folder.mkdir()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (write_another_thing, "row.json: no record of a row's run: TypeError"),
        (begin_anew, "is no finished run of it with seed 1; move .*seed_1.json away"),
        (leave_an_empty_folder, "is no finished run of it with seed 1"),
        (take_another_seeds, "is a run of another seed, other settings or other files"),
        (go_on_by_hand, "is a run of another seed, other settings or other files"),
        (train_elsewhere, "is another run than .*seed_1.json is of; move"),
    ],
)
def test_a_row_learns_from_no_other_run(tmp_path, teacher, change, message):
    change(*teacher)
    with pytest.raises(ValueError, match=f"row 'pole/nothing', .*{message}"):
        is_asked(tmp_path)


def test_a_row_learns_from_no_run_of_earlier_settings(tmp_path, teacher):
    with pytest.raises(ValueError, match="other settings"):
        is_asked(tmp_path, settings="changed")


def test_a_row_whose_source_has_a_result_but_no_run_says_so_before_it_begins(
    tmp_path, teacher, monkeypatch
):
    monkeypatch.setattr(measuring.RowCfgs, "fits", lambda self, name, result: True)
    runs = Runs(table(tmp_path), tmp_path / "results", tmp_path / "runs", smoke=False)
    monkeypatch.setattr(Runs, "_start", lambda *_: pytest.fail("it begins"))
    begin_anew(*teacher)
    said = []
    assert runs.run([("pole/bc", 1)], gpus=[""], until=math.inf, note=said.append) == 1
    assert "pole/bc, seed 1: row 'pole/nothing', which it learns from: " in said[0]
    assert "is no finished run of it with seed 1" in said[0]


@pytest.mark.full
def test_the_whole_chain_runs(tmp_path):
    """Two iterations each: episodes are recorded, cloned, and PPO goes on."""
    rows = table(tmp_path).rows
    cfgs = RowCfgs(rows, smoke=True)
    found = {}
    for name in ROWS:
        run_folder = tmp_path / "runs" / name / "seed_1"
        found[name] = measure(
            rows[name],
            1,
            run_folder,
            device="cpu",
            smoke=True,
            sources=Sources(runs=tmp_path / "runs", fits=cfgs.fits),
        )
    episodes = read_episodes(tmp_path / "runs/pole/nothing/seed_1" / EPISODES)
    assert found["pole/nothing"]["recorded_env_states"] == len(episodes.env_states_D) > 0
    assert "pole/bc/seed_1" in (tmp_path / "runs/pole/online/seed_1" / CONFIG).read_text()
    assert found["pole/online"]["settings"] == cfgs.settings("pole/online")
