"""Tables are read from YAML; the shipped ones name tasks that exist and figures that add up."""

import functools
import re
import statistics
from pathlib import Path

import pytest

from ksim_rl import envs
from ksim_rl.suites.dm_control.domains import DOMAINS
from ksim_rl.tables.measure import HELD_OUT, run_cfg
from ksim_rl.tables.table import load, shipped

OWN = """
title: Ours
groups:
  ppo:
    objective: ppo
    env_states: 1.0e+6
    seeds: [1, 2]
    against: PPO
    rows:
      Balance: {task: cartpole_balance, published: {PPO: 900}}
      Swingup: {task: cartpole_swingup, env_states: 2.0e+6}
"""


def written(tmp_path, text=OWN):
    path = tmp_path / "ours.yaml"
    path.write_text(text)
    return str(path)


def test_rows_inherit_the_fields_of_their_group(tmp_path):
    table = load(written(tmp_path))
    balance, swingup = table.rows["ppo/Balance"], table.rows["ppo/Swingup"]
    assert (table.name, balance.seeds, balance.env_states, balance.goal) == (
        "ours",
        (1, 2),
        1e6,
        900.0,
    )
    assert (swingup.env_states, swingup.goal) == (2e6, None)
    assert table.groups() == {"ppo": ["ppo/Balance", "ppo/Swingup"]}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds: [1, 2]", "seeds: [1, 1]", "rows.ppo/Balance.seeds=.*each once"),
        ("task: cartpole_balance", "tsak: cartpole_balance", "unknown field .*tsak.*task"),
        ("against: PPO", "measure: seconds", "levels=.*measure=seconds"),
        ("against: PPO", "overrides: [seed=3]", "'seed=3' has a field of its own"),
        ("rows:", "lines:", "groups that have rows"),
        ("against: PPO", "figures: {best: trials}", "figures.best='trials': expected seconds"),
        ("against: PPO", "figures: {best: success}", "figures.best='success': .*no trials"),
        (
            "against: PPO",
            "figures: {best: evaluation/course_least}",
            "figures.best='evaluation/course_least': no course",
        ),
        ("against: PPO", "figures: {falls: seconds}", "figures.falls: .*another name"),
    ],
)
def test_what_is_wrong_in_a_table_is_named(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=message):
        load(written(tmp_path, OWN.replace(old, new)))


def test_a_table_that_does_not_exist_gives_the_near_names():
    with pytest.raises(ValueError, match="'dm_control'"):
        load("dm_contrl")


def test_the_shipped_tables_name_tasks_that_exist():
    assert shipped() == [
        "dm_control",
        "humanoids",
        "imitation",
        "manipulation",
        "motions",
        "pixels",
        "rough",
        "tasks",
        "tracking",
        "velocity",
    ]
    for name in shipped():
        assert {row.task for row in load(name).rows.values()} <= set(envs.names())


def test_the_published_means_of_23_tasks_are_those_of_the_issue():
    table = load("dm_control")
    without = table.means["mean_23"].without
    assert set(table.groups()) == {"ppo", "fast_sac"}
    for names in table.groups().values():
        rows = [table.rows[name] for name in names if name.rpartition("/")[2] not in without]
        assert (len(names), len(rows)) == (25, 23)
        for who, mean in (("PPO", 596), ("SAC", 659), ("REPPO", 749)):
            assert round(statistics.fmean(row.published[who] for row in rows)) == mean


def test_the_other_algorithm_stays_within_its_env_states():
    long = ("Hopper", "Humanoid", "Acrobot", "Pendulum")
    for name, row in load("dm_control").rows.items():
        group, _, task = name.partition("/")
        if group == "fast_sac":
            assert row.env_states <= (100e6 if task.startswith(long) else 20e6)


@functools.cache
def composed(table, row):
    """The config of a row's second seed, which several tests look at."""
    return run_cfg(load(table).rows[row], 2, device="cpu")


@pytest.mark.parametrize(
    "name",
    [
        "velocity:fast_sac/go1",
        "humanoids:g1_flat",
        "rough:go1",
        *(
            pytest.param(f"rough:{row}", marks=pytest.mark.full)
            for row in load("rough").rows
            if row != "go1"
        ),
        *(f"pixels:{row}" for row in load("pixels").rows),
        "manipulation:panda_pick_cube",
        "manipulation:leap_cube_reorient",
        *(
            pytest.param(f"imitation:{row}", marks=[pytest.mark.full] if number else [])
            for number, row in enumerate(load("imitation").rows)
        ),
        "motions:g1_track",
        pytest.param("motions:g1_style", marks=pytest.mark.full),
        *(f"tracking:{clip}" for clip in ("walk", "squat", "turn", "kick")),
        *(f"tasks:{row}" for row in load("tasks").rows),
        *(
            pytest.param(f"dm_control:{row}", marks=pytest.mark.full)
            for row in load("dm_control").rows
        ),
    ],
)
def test_a_row_composes_with_one_evaluation_at_its_end_and_at_most_its_env_states(name):
    table, _, row_name = name.partition(":")
    row, cfg = load(table).rows[row_name], composed(table, row_name)
    states = cfg.trainer.num_iterations * cfg.num_envs * cfg.data.rollout_length(cfg.num_envs)
    assert 0.95 * row.env_states < states <= row.env_states
    assert (cfg.seed, cfg.trainer.eval_interval, cfg.trainer.eval_episodes) == (2, 0, row.episodes)
    assert not cfg.trainer.stop_when_solved and cfg.trainer.stop_at is None


def test_the_tables_have_every_task_and_that_of_tasks_asks_of_each_what_the_task_does():
    rows = load("tasks").rows
    elsewhere = {
        row.task
        for name in ("velocity", "humanoids", "tracking", "motions", "pixels")
        for row in load(name).rows.values()
        if not envs.task(row.task).suite
    }
    # A teacher is there for its student, and is in the table of its own task as well.
    elsewhere.discard(load("pixels").rows["go1_heights"].task)
    own = [name for name in envs.names() if not envs.task(name).suite]
    assert sorted([*(row.task for row in rows.values()), *elsewhere]) == own
    for name, row in rows.items():
        task = envs.task(row.task)
        assert name.rpartition("/")[2] == row.task and row.goal == task.solved_at
        if name.startswith("control/"):
            # With which the task composes, too: `tests/conf` looks at each.
            trained = task.training.trainer.num_iterations
            assert composed("tasks", name).trainer.num_iterations == trained


@pytest.mark.parametrize("table", ["humanoids", "motions", "tasks", "velocity"])
def test_levels_and_figures_are_of_metrics_that_the_task_has(table):
    for row in load(table).rows.values():
        cfg = envs.task(row.task).cfg()
        known = {f"reward/{name}" for name in cfg.rewards} | {HELD_OUT, "seconds", "success"}
        for name in cfg.metrics:
            known |= {f"metric/{name}", f"evaluation/metric/{name}"}
        assert {*row.levels, *row.figures.values()} <= known, row.task


def test_the_table_of_motions_writes_the_figures_that_its_page_names():
    rows = load("motions").rows
    assert set(rows["g1_track"].figures) == {"least_trained", "mean_held_out", "seconds"}
    assert rows["g1_carry_box"].figures == {"success": "evaluation/metric/success"}


PAGE = Path(__file__).parents[2] / "docs" / "tables.md"
SUITES = PAGE.with_name("suites.md")


def test_the_table_of_the_page_can_be_read(tmp_path):
    text = re.search(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert text is not None
    assert list(load(written(tmp_path, text[1])).rows) == ["ppo/Balance", "ppo/Swingup", "fast/go1"]


def test_the_page_has_the_iterations_that_playground_gives_each_domain():
    for name, domain in DOMAINS.items():
        sim = domain.playground["sim"]
        assert f"| {name} | {sim.iterations} / {sim.ls_iterations} |" in SUITES.read_text()
