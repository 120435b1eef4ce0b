"""Tables of strangers that reach beyond the folders of `reproduce`, or name variables of the environment."""

import contextlib
import io
import os
from pathlib import Path
from unittest import mock

import yaml

from ksim_rl.cli import main

SECRET = "a-token-that-nobody-may-see"
INNER = r"$\{oc.env\:KSIM_RL_SECRET\}"


def table(place, *overrides, group="ppo", row="One", task="cartpole_balance", **fields):
    """Return a table of one row, as a tree."""
    shared = {"objective": "ppo", "env_states": 1000.0, "seeds": [1], "overrides": list(overrides)}
    return {"title": "Ours", **fields, "groups": {group: {**shared, "rows": {row: {"task": task}}}}}


STRANGE = {
    "name_that_is_a_path": lambda place: table(place, name=f"{place}/outside/written"),
    "name_that_leads_out": lambda place: table(place, name="../../outside/written"),
    "name_of_the_folder_above": lambda place: table(place, name=".."),
    "name_that_hides": lambda place: table(place, name=".git"),
    "group_that_is_a_path": lambda place: table(place, group=f"{place}/outside/written"),
    "group_that_leads_out": lambda place: table(place, group="../../../outside"),
    "row_that_is_a_path": lambda place: table(place, row=f"{place}/outside/written"),
    "row_that_leads_out": lambda place: table(place, row="../../../../outside/kept"),
    "row_with_a_line_break": lambda place: table(place, row="a\nb"),
    "folder_of_the_nan_guard": lambda place: table(
        place, f"task.sim.nan_guard={{folder: {place}/outside/written}}"
    ),
    "database_of_mlflow": lambda place: table(
        place, f"logger.mlflow={{tracking_uri: 'sqlite:///{place}/outside/written'}}"
    ),
    "viewer": lambda place: table(place, "viewer.browser=true"),
    "viewer_for_everybody": lambda place: table(place, "viewer.host=0.0.0.0"),
    "folder_of_hydra": lambda place: table(place, f"hydra.run.dir={place}/outside/written"),
    "logging_of_hydra": lambda place: table(place, "hydra/job_logging=none"),
    "interpolation": lambda place: table(place, "logger.wandb={name: '${oc.env:KSIM_RL_SECRET}'}"),
    "interpolation_with_escapes": lambda place: table(place, f"logger.wandb={{name: {INNER}}}"),
    "interpolation_in_a_list": lambda place: table(place, f"task.viewer.draw=[{INNER}]"),
    "interpolation_by_a_cast": lambda place: table(place, f"task.viewer.body=str({INNER})"),
    "interpolation_of_a_choice": lambda place: table(place, f"logger={INNER}"),
    "interpolation_of_a_field": lambda place: table(place, f"trainer.log_interval={INNER}"),
    "interpolation_of_a_task": lambda place: table(place, task=INNER),
    "seed_by_another_spelling": lambda place: table(place, "++seed=3"),
    "task_by_another_spelling": lambda place: table(place, "+task=reacher"),
    "several_values": lambda place: table(place, "trainer.log_interval=1,2"),
    "plug_in": lambda place: table(place, "+plugins=[antigravity]"),
    "class_of_a_stranger": lambda place: table(
        place, "+task.rewards.x={_target_: antigravity.fly}"
    ),
    "override_that_does_not_parse": lambda place: table(place, "a={"),
}


def tried(name, place: Path):
    """Run `ksim-rl reproduce` on a strange table; return its exit code, what it said, and what it did elsewhere."""
    outside, work = place / "outside", place / "work"
    for folder in (outside / "kept", work):
        folder.mkdir(parents=True)
    kept = outside / "kept" / "seed_1.json"
    kept.write_text("{}")
    path = place / "table.yaml"
    path.write_text(yaml.safe_dump(STRANGE[name](place)))
    before = {found for found in place.rglob("*") if found != work}
    said = io.StringIO()
    words = [
        "reproduce",
        str(path),
        "--smoke",
        "--device",
        "cpu",
        "--output",
        "tables",
        "--runs",
        "runs",
    ]
    code = 0
    with (
        mock.patch.dict(os.environ, {"KSIM_RL_SECRET": SECRET}),
        contextlib.chdir(work),
        contextlib.redirect_stderr(said),
        contextlib.redirect_stdout(said),
    ):
        try:
            main.main(words)
        except SystemExit as ended:
            code = ended.code
    after = {found for found in place.rglob("*") if found != work}
    signs = sorted(str(found) for found in before ^ after)
    signs += ["deleted"] * (not kept.exists()) + ["secret"] * (SECRET in said.getvalue())
    return code, said.getvalue(), signs


def figures(place, *, tables):
    """Try strange tables; count what is not refused in one line, and what was written, deleted or told."""
    found = {"tables": 0, "not_refused_in_one_line": 0, "written_deleted_or_leaked": 0}
    for name in list(STRANGE)[:: max(1, len(STRANGE) // tables)]:
        code, said, signs = tried(name, place / name)
        one_line = said.startswith("ksim-rl: error: ") and said.count("\n") == 1
        found["tables"] += 1
        found["not_refused_in_one_line"] += code != 2 or not one_line
        found["written_deleted_or_leaked"] += len(signs)
        if code != 2 or not one_line or signs:
            print(f"{name}: exit code {code}: {said[-300:]} {signs}", flush=True)
    return found
