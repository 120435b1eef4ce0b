"""What a row reads beside its settings: other files are another row, whatever they are called."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.tables import measure as measuring
from ksim_rl.tables.measure import RowCfgs, run_cfg
from ksim_rl.tables.runner import Runs
from ksim_rl.tables.table import load

TABLE = """
title: Rows that read files
groups:
  "":
    objective: ppo
    env_states: 1.0e+6
    seeds: [1]
    rows:
      style: {task: walker_amp, objective: amp, overrides: ["objective.motions=[CLIPS]"]}
      after: {task: walker_amp, begins_from: style}
      shipped: {task: walker_amp, objective: amp}
      clone: {task: cartpole_swingup, objective: bc, overrides: [objective.episodes=EPISODES]}
"""


COMPOSED = {}


def composed_once(row, seed, **options):
    """Compose a config as `run_cfg` does, once for all tests of this file, since that takes long."""
    key = repr(row)
    if key not in COMPOSED:
        COMPOSED[key] = run_cfg(row, seed, **options)
    return COMPOSED[key]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("place")


@pytest.fixture
def folder(place, monkeypatch):
    """A table, the clips and the episodes that its rows read."""
    monkeypatch.setattr(measuring, "run_cfg", composed_once)
    shutil.rmtree(place)
    (place / "clips").mkdir(parents=True)
    (place / "episodes" / "env_states").mkdir(parents=True)
    shutil.copy(motion_path("walker_walk"), place / "clips" / "walk.npz")
    (place / "episodes" / "episodes.json").write_text("{}")
    (place / "episodes" / "env_states" / "action.memmap").write_bytes(b"\0\1")
    text = TABLE.replace("CLIPS", str(place / "clips"))
    text = text.replace("EPISODES", str(place / "episodes"))
    (place / "ours.yaml").write_text(text)
    return place


def counted(folder: Path) -> set[str]:
    """Return the rows whose results count, by the runs of another process."""
    table = load(str(folder / "ours.yaml"))
    runs = Runs(table, folder / "results", folder / "runs", smoke=False)
    return {name for name, results in runs.results().items() if results}


def write_results(folder: Path, *, with_files: bool = True) -> None:
    cfgs = RowCfgs(load(str(folder / "ours.yaml")).rows)
    for name in cfgs.rows:
        result = {"settings": cfgs.settings(name)}
        if with_files:
            result["files"] = {file.name: file.sha256() for file in cfgs.read_by(name)}
        path = folder / "results" / name / "seed_1.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result))


ALL = {"style", "after", "shipped", "clone"}


def add_a_clip(folder):
    shutil.copy(motion_path("walker_walk"), folder / "clips" / "other.npz")


def rename_a_clip(folder):
    (folder / "clips" / "walk.npz").rename(folder / "clips" / "run.npz")


def change_a_clip(folder):
    with (folder / "clips" / "walk.npz").open("ab") as file:
        file.write(b"\0")


def change_an_episode(folder):
    (folder / "episodes" / "env_states" / "action.memmap").write_bytes(b"\0\2")


def add_an_episode(folder):
    (folder / "episodes" / "env_states" / "reward.memmap").write_bytes(b"\0")


@pytest.mark.parametrize(
    ("change", "outdated"),
    [
        (add_a_clip, {"style", "after"}),
        (rename_a_clip, {"style", "after"}),
        (change_a_clip, {"style", "after"}),
        (change_an_episode, {"clone"}),
        (add_an_episode, {"clone"}),
    ],
)
def test_a_result_counts_until_a_file_changes_that_its_row_or_a_source_of_it_reads(
    folder, change, outdated
):
    write_results(folder)
    assert counted(folder) == ALL
    change(folder)
    assert counted(folder) == ALL - outdated


def test_results_count_where_their_files_are_not(folder):
    """A table can be written from results that another machine has made."""
    write_results(folder)
    shutil.rmtree(folder / "clips")
    shutil.rmtree(folder / "episodes")
    assert counted(folder) == ALL


def test_a_result_of_before_hashes_counts_where_all_files_are_the_packages(folder):
    write_results(folder, with_files=False)
    assert counted(folder) == {"shipped"}


def test_what_a_row_learns_from_above_is_no_file_of_its_own(folder):
    rows = load(str(folder / "ours.yaml")).rows
    cfgs = RowCfgs(rows)
    names = [file.name for file in cfgs.read_by("after")]
    assert "checkpoint" not in names
    assert f"style: files/{folder / 'clips'}" in names
    own = replace(rows["shipped"], overrides=("checkpoint=elsewhere",))
    assert "checkpoint" in [file.name for file in RowCfgs({"own": own}).read_by("own")]
