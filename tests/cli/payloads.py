"""Families of payloads in run folders of strangers: what writes each one, and what removes the check that stops it."""

import contextlib
import copy
import hashlib
import io
import json
import os
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import safetensors.torch
import torch
import yaml
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from ksim_rl import conf
from ksim_rl.cli import main, run_commands, train
from ksim_rl.config import plain_data, plugins
from ksim_rl.export import folder as export_folder
from ksim_rl.scene.actuators import nets
from ksim_rl.trainers import checkpoint, run_cfg

SECRET = "a-token-that-nobody-may-see"
SMALL = ("num_envs=16", "data.num_env_states_per_minibatch=32", "logger.tensorboard=false")


@dataclass(frozen=True)
class Place:
    """A stranger's run folder, and a folder outside of it that nothing may touch."""

    run: Path
    outside: Path
    tree: dict

    @property
    def expression(self) -> str:
        """What does the same where an expression is evaluated that Hydra's own blocklist lets through."""
        return f"__import__('os').system('touch {self.outside / 'executed'}')"

    @property
    def code(self) -> str:
        """Python code that leaves a mark outside."""
        return f"open({str(self.outside / 'executed')!r}, 'w').close()"

    def write_config(self, text: str = "", **more) -> list[str]:
        """Write config.yaml with `more` at its top; return the command that makes the run once more."""
        tree = {**copy.deepcopy(self.tree), **more}
        (self.run / "config.yaml").write_text(yaml.safe_dump(tree, sort_keys=False) + text)
        return ["train", "--config-dir", str(self.run), f"hydra.run.dir={self.run.parent / 'new'}"]

    def write_checkpoint(self, state: dict | None = None, **more) -> list[str]:
        """Write a checkpoint whose manifest has a config with `more` at its top; return the command that reads it."""
        config = {**copy.deepcopy(self.tree), **more}
        checkpoint.save(self.run / "checkpoint", state or {"x": torch.zeros(1)}, iteration=1, config=config)
        return ["eval", str(self.run)]


def as_a_run_would(cfg, folder, resume_from=None):
    """Write what a run writes before it trains, at the same places."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(cfg.to_tree())))
    if "KSIM_RL_MARK" in os.environ:
        (folder / "environment").write_text(SECRET)
    if cfg.task.sim.nan_guard is not None:
        Path(cfg.task.sim.nan_guard.folder).mkdir(parents=True)
    if cfg.viewer.browser:  # a port is opened, which lets in who reaches it
        (folder / "environment").write_text(SECRET)
    if cfg.logger.mlflow is not None:
        Path(cfg.logger.mlflow.tracking_uri.removeprefix("sqlite:///")).write_text("")
    return 0


def without_the_check_of_config(monkeypatch, load=OmegaConf.load):
    """Let `--config-dir RUN` take the config as it is, and Hydra look for configs in the folder, as once was."""

    def register_run(folder, given=()):
        plain = run_cfg.without_env_size(
            OmegaConf.to_container(OmegaConf.create(load(folder / "config.yaml")))
        )
        node = {"defaults": ["launch", "_self_"], **plain}
        ConfigStore.instance().store(name=conf.RUN_AGAIN, node=node)
        monkeypatch.setattr(conf, "__file__", str(folder / "__init__.py"))

    monkeypatch.setattr(conf, "register_run", register_run)
    monkeypatch.setattr(run_cfg, "check_plain", lambda *_: None)


def unsafe_load(path):
    return yaml.unsafe_load(path.read_text())


FAMILIES: dict[str, tuple[Callable, Callable]] = {}


def family(without=without_the_check_of_config):
    """Register what writes a payload, with what removes its check from the build."""

    def register(write):
        FAMILIES[write.__name__] = (write, without)
        return write

    return register


# -- config.yaml: Hydra's own part ------------------------------------------------------------------------------------


@family()
def callback(place):
    return place.write_config(
        hydra={"callbacks": {"x": {"_target_": "sympy.sympify", "a": place.expression}}}
    )


@family()
def handler_of_job_logging(place):
    handlers = {"x": {"()": "sympy.sympify", "a": place.expression}}
    return place.write_config(
        hydra={"job_logging": {"version": 1, "handlers": handlers, "root": {"handlers": ["x"]}}}
    )


@family()
def file_of_hydra_logging(place):
    handlers = {"x": {"class": "logging.FileHandler", "filename": str(place.outside / "written")}}
    logs = {"version": 1, "handlers": handlers, "root": {"handlers": ["x"]}}
    return place.write_config(hydra={"hydra_logging": logs, "verbose": False})


@family()
def folder_of_the_job(place):
    return place.write_config(hydra={"run": {"dir": str(place.outside / "written")}})[:3]


@family()
def variables_of_the_job(place):
    return place.write_config(hydra={"job": {"env_set": {"KSIM_RL_MARK": "1"}}})


@family()
def defaults_list(place):
    handlers = {"x": {"()": "sympy.sympify", "a": place.expression}}
    logs = {"version": 1, "handlers": handlers, "root": {"handlers": ["x"]}}
    evil = "# @package _global_\n" + yaml.safe_dump({"hydra": {"hydra_logging": logs}})
    (place.run / "evil.yaml").write_text(evil)
    return [*place.write_config(defaults=["launch", "evil", "_self_"]), "--help"]


# -- YAML beside config.yaml ------------------------------------------------------------------------------------------


@family()
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
    return group(place, GROUP + "wandb: {entity: KSIM_RL_SECRET, name: '${oc.env:${logger.wandb.entity}}'}\n")


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
    alone = {name: place.tree[name] for name in ("task_name", "num_envs", "seed", "device", "checkpoint")}
    evil = {"hydra": {"callbacks": {"x": {"_target_": "sympy.sympify", "a": place.expression}}}, **alone}
    (place.run / "run.yaml").write_text("# @package _global_\n" + yaml.safe_dump(evil))
    return ["train", "--config-dir", str(place.run)]


@family(without_the_check_of_groups)
def group_file_that_spells_hydra_with_escapes(place):
    (place.run / "logger").mkdir()
    text = f'"h\\x79dra":\n  callbacks:\n    x: {{_target_: sympy.sympify, a: "{place.expression}"}}\n'
    (place.run / "logger" / "local.yaml").write_text("# @package _global_\n" + text)
    return ["train", "--config-dir", str(place.run)]


# -- config.yaml: values ----------------------------------------------------------------------------------------------


def with_logger(place, **logger):
    return place.write_config(logger={**place.tree["logger"], **logger})


@family()
def interpolation_of_the_environment(place):
    return with_logger(place, wandb={"name": "${oc.env:KSIM_RL_SECRET}"})


@family()
def interpolation_of_a_key_elsewhere(place):
    hidden = "${oc.env:${logger.wandb.entity}}"
    return with_logger(place, wandb={"entity": "KSIM_RL_SECRET", "name": hidden})


@family(lambda monkeypatch: without_the_check_of_config(monkeypatch, unsafe_load))
def tag_of_an_object(place):
    return place.write_config(f"x: !!python/object/apply:eval [{json.dumps(place.code)}]\n")


@family(lambda monkeypatch: monkeypatch.setattr(plain_data, "check_events", lambda *_: None))
def exploding_anchors(place):
    lines = ["checkpoint: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]" for level in range(1, 4)]
    command = place.write_config()
    (place.run / "config.yaml").write_text("\n".join(lines))
    return command


@family(lambda monkeypatch: (without_the_check_of_config(monkeypatch), any_name(monkeypatch)))
def task_name_that_leads_out(place):
    return place.write_config(task_name="../../outside/written")[:3]


def any_name(monkeypatch):
    monkeypatch.setattr(run_cfg, "TASK_NAME", run_cfg.re.compile(".*"))


def without_the_check_of_places(monkeypatch):
    monkeypatch.setattr(run_cfg, "WRITTEN", ())


@family(without_the_check_of_places)
def folder_of_the_nan_guard(place):
    task = copy.deepcopy(place.tree["task"])
    task["sim"]["nan_guard"] = {"folder": str(place.outside / "written")}
    return place.write_config(task=task)


@family(without_the_check_of_places)
def database_of_mlflow(place):
    return with_logger(place, mlflow={"tracking_uri": f"sqlite:///{place.outside}/written"})


@family(without_the_check_of_places)
def viewer_that_listens(place):
    place.write_checkpoint(viewer={"browser": True})
    return ["resume", str(place.run)]


@family(without_the_check_of_places)
def viewer_that_listens_in_config(place):
    return place.write_config(viewer={"browser": True})


@family(without_the_check_of_places)
def database_of_mlflow_in_a_manifest(place):
    place.write_checkpoint(
        logger={**place.tree["logger"], "mlflow": {"tracking_uri": f"sqlite:///{place.outside}/written"}}
    )
    return ["resume", str(place.run)]


# -- classes and packages ---------------------------------------------------------------------------------------------


def a_package(place):
    """Make a package whose import leaves a mark, where Python finds it."""
    (place.run / "stranger.py").write_text(
        textwrap.dedent(f"""
        from dataclasses import dataclass
        {place.code}
        @dataclass
        class Robot:
            pass
        """)
    )


def any_package(monkeypatch):
    monkeypatch.setattr(plugins, "packages", lambda: frozenset({"stranger"}))


def with_target(place, target):
    task = copy.deepcopy(place.tree["task"])
    first = next(iter(task["scene"]["robots"]))
    task["scene"]["robots"][first] = {"_target_": target}
    return task


@family(any_package)
def class_of_a_package_in_config(place):
    a_package(place)
    return place.write_config(task=with_target(place, "stranger.Robot"))


@family(any_package)
def class_of_a_package_in_a_manifest(place):
    a_package(place)
    return place.write_checkpoint(task=with_target(place, "stranger.Robot"))


def load_what_is_remembered(monkeypatch):
    monkeypatch.setattr(plugins, "check_remembered", plugins.load)


@family(load_what_is_remembered)
def plugin_in_config(place):
    a_package(place)
    return place.write_config(plugins=["stranger"])


@family(load_what_is_remembered)
def plugin_in_a_manifest(place):
    a_package(place)
    return place.write_checkpoint(plugins=["stranger"])


# -- checkpoints and data files ---------------------------------------------------------------------------------------


class Bomb:
    """Runs code where it is unpickled."""

    def __init__(self, code):
        self.code = code

    def __reduce__(self):
        return exec, (self.code,)


def with_pickles(monkeypatch):
    def load(data):
        return torch.load(io.BytesIO(data), weights_only=False)

    monkeypatch.setattr(safetensors.torch, "load", load)
    monkeypatch.setattr(nets, "load", load)


@family(with_pickles)
def pickle_for_the_tensors_of_a_checkpoint(place):
    command = place.write_checkpoint()
    saved = checkpoint.saved(place.run / "checkpoint")[-1]
    data = io.BytesIO()
    torch.save({"x": Bomb(place.code)}, data)
    (saved / checkpoint.TENSORS).write_bytes(data.getvalue())
    manifest = json.loads((saved / checkpoint.MANIFEST).read_text())["manifest"]
    digest = hashlib.sha256(data.getvalue()).hexdigest()
    manifest["files"][checkpoint.TENSORS] = {"bytes": len(data.getvalue()), "sha256": digest}
    (saved / checkpoint.MANIFEST).write_bytes(checkpoint._seal(manifest))
    return command


def follow_links(monkeypatch):
    monkeypatch.setattr(os, "O_NOFOLLOW", 0)
    monkeypatch.setattr(run_commands, "check_links", lambda *_, **__: None)


@family(follow_links)
def link_for_the_config_of_a_run_that_goes_on(place):
    place.write_checkpoint()
    (place.run / "config.yaml").symlink_to(place.outside / "written")
    return ["resume", str(place.run)]


@family(follow_links)
def link_for_the_folder_of_checkpoints(place):
    place.write_checkpoint()
    (place.run / "checkpoint").rename(place.outside.parent / "other")
    (place.outside.parent / "outside" / "checkpoint").symlink_to(place.outside.parent / "other")
    (place.run / "checkpoint").symlink_to(place.outside / "checkpoint")
    (place.run / "config.yaml").symlink_to(place.outside / "written")
    return ["resume", str(place.run)]


# -- exports ----------------------------------------------------------------------------------------------------------


def written_where_it_is(monkeypatch):
    @contextlib.contextmanager
    def as_it_is(path, below):
        path.mkdir(exist_ok=True)
        yield path

    def fill(trained, path, **_):
        for name in ("README.md", "written"):
            (path / name).write_text("x")

    for name in ("check_folder", "check_own"):
        monkeypatch.setattr(export_folder, name, lambda *_, **__: None)
    monkeypatch.setattr(export_folder, "whole_folder", as_it_is)
    monkeypatch.setattr(export_folder, "policy_of", lambda *_, **__: None)
    monkeypatch.setattr(export_folder, "_fill", fill)


@family(written_where_it_is)
def link_for_the_folder_of_an_export(place):
    place.write_checkpoint()
    (place.run / "export").symlink_to(place.outside)
    return ["export", str(place.run)]


@family(written_where_it_is)
def link_for_a_file_of_an_export(place):
    place.write_checkpoint()
    (place.run / "export").mkdir()
    (place.run / "export" / "README.md").symlink_to(place.outside / "written")
    return ["export", str(place.run)]


# -- what is done and seen ---------------------------------------------------------------------------------------------


def call(arguments):
    with pytest.raises(SystemExit) as stopped:
        main.main(arguments)
    return stopped.value.code


def signs(place, shown: str) -> list[str]:
    """Return what a payload has done: marks outside, a changed environment, a secret in files or on the terminal."""
    found = [str(path) for path in place.outside.rglob("*") if path.name in ("executed", "written")]
    base = place.run.parent
    read = [path.read_text(errors="replace") for path in base.rglob("*") if path.is_file()]
    return found + ["secret"] * any(SECRET in text for text in [shown, *read])
