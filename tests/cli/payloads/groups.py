"""Payloads in YAML beside config.yaml, and in folders of config groups."""

import yaml

from ksim_rl import conf
from ksim_rl.cli import train
from tests.cli.payloads.configs import without_the_check_of_config
from tests.cli.payloads.place import SMALL, family


@family(without_the_check_of_config)
def group_file_beside_the_config(place):
    folder = place.run / "hydra" / "hydra_logging"
    folder.mkdir(parents=True)
    handlers = {"x": {"()": "sympy.sympify", "a": place.expression}}
    logs = {"version": 1, "handlers": handlers, "root": {"handlers": ["x"]}}
    (folder / "colorlog.yaml").write_text(yaml.safe_dump(logs))
    return [*place.write_config(), "hydra/hydra_logging=colorlog", "--help"]


def without_the_check_of_groups(monkeypatch):
    monkeypatch.setattr(conf, "check_groups", lambda folder: None)


def group(place, text, name="logger"):
    """Write a group into a stranger's folder, and choose it."""
    (place.run / name).mkdir()
    (place.run / name / "mine.yaml").write_text(text)
    choice = f"{'+' if name == 'experiment' else ''}{name}=mine"
    new = f"hydra.run.dir={place.run.parent / 'new'}"
    return ["train", "--config-dir", str(place.run), *SMALL[:2], choice, new]


GROUP = "csv: true\ntensorboard: false\n"


@family(without_the_check_of_groups)
def group_that_reads_the_environment(place):
    return group(place, GROUP + "wandb: {name: '${oc.env:KSIM_RL_SECRET}'}\n")


@family(without_the_check_of_groups)
def group_that_reads_the_environment_by_a_reference(place):
    return group(
        place, GROUP + "wandb: {entity: KSIM_RL_SECRET, name: '${oc.env:${logger.wandb.entity}}'}\n"
    )


def as_anybody_may(monkeypatch):
    without_the_check_of_groups(monkeypatch)
    monkeypatch.setattr(train, "reaching_outside", lambda *_, **__: [])


PORT = "# @package _global_\nviewer: {browser: true, host: 0.0.0.0}\n"


@family(as_anybody_may)
def group_that_opens_a_port(place):
    return group(place, PORT, "experiment")


@family(as_anybody_may)
def group_that_writes_elsewhere(place):
    text = f"task: {{sim: {{nan_guard: {{folder: {place.outside / 'written'}}}}}}}\n"
    return group(place, f"# @package _global_\n{text}", "experiment")


@family(as_anybody_may)
def group_behind_a_link(place):
    other = place.run.parent / "other"
    other.mkdir()
    (other / "mine.yaml").write_text(PORT)
    words = group(place, GROUP)
    (place.run / "extra").symlink_to(other)
    return [*words, "+extra=mine"]


@family(as_anybody_may)
def group_of_a_folder_on_the_search_path(place):
    own = place.run.parent / "own"
    (own / "logger").mkdir(parents=True)
    (own / "logger" / "quiet.yaml").write_text(GROUP)
    words = group(place, PORT, "experiment")
    return ["train", "--config-dir", str(own), *words[3:], f"hydra.searchpath=[file://{place.run}]"]


@family(without_the_check_of_groups)
def folder_of_groups_that_shadows_ours(place):
    (place.run / "logger").mkdir()
    (place.run / "logger" / "quiet.yaml").write_text("csv: false\ntensorboard: false\n")
    alone = {
        name: place.tree[name] for name in ("task_name", "num_envs", "seed", "device", "checkpoint")
    }
    evil = {
        "hydra": {"callbacks": {"x": {"_target_": "sympy.sympify", "a": place.expression}}},
        **alone,
    }
    (place.run / "run.yaml").write_text("# @package _global_\n" + yaml.safe_dump(evil))
    return ["train", "--config-dir", str(place.run)]


@family(without_the_check_of_groups)
def group_file_that_spells_hydra_with_escapes(place):
    (place.run / "logger").mkdir()
    text = (
        f'"h\\x79dra":\n  callbacks:\n    x: {{_target_: sympy.sympify, a: "{place.expression}"}}\n'
    )
    (place.run / "logger" / "local.yaml").write_text("# @package _global_\n" + text)
    return ["train", "--config-dir", str(place.run)]
