"""Run folders of strangers: what could execute, leak or write elsewhere is refused in one line.

Each family of payloads is generated here, over every kind of file that a run folder holds, and is shown to work where
its check is removed: so the check is what stops it, and not luck.
"""

import contextlib
import copy
import hashlib
import io
import json
import logging
import os
import pickle
import sys
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
import yaml
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from ksim_rl import conf
from ksim_rl.cli import main, run_commands, train
from ksim_rl.config import class_paths, plain_data, plugins
from ksim_rl.scene.actuators import nets
from ksim_rl.scene.motions import motion
from ksim_rl.trainers import checkpoint, loggers, run_cfg, run_folder

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


@pytest.fixture(scope="module")
def tree():
    return conf.compose(SMALL).to_tree()


@pytest.fixture
def place(tree, tmp_path, monkeypatch):
    for name in ("run", "outside", "work"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.syspath_prepend(str(tmp_path / "run"))
    monkeypatch.setenv("KSIM_RL_SECRET", SECRET)
    monkeypatch.delenv("KSIM_RL_MARK", raising=False)
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.setattr(plugins, "_named", [])
    for module in (train, run_commands):
        monkeypatch.setattr(module, "run_and_report", as_a_run_would)
    handlers = list(logging.root.handlers)
    yield Place(run=tmp_path / "run", outside=tmp_path / "outside", tree=tree)
    logging.root.handlers[:] = handlers
    sys.modules.pop("stranger", None)


def as_a_run_would(cfg, folder, resume_from=None):
    """Write what a run writes before it trains, at the same places."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(cfg.to_tree())))
    if "KSIM_RL_MARK" in os.environ:
        (folder / "environment").write_text(SECRET)
    if cfg.task.sim.nan_guard is not None:
        Path(cfg.task.sim.nan_guard.folder).mkdir(parents=True)
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
    saved = checkpoint.latest(place.run)
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


# -- the two builds ---------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("name", FAMILIES)
def test_a_payload_is_refused_in_one_line_and_does_nothing(name, place, capsys):
    command = FAMILIES[name][0](place)
    before = sorted(map(str, place.run.parent.rglob("*")))
    assert call(command) == 2
    error = capsys.readouterr().err
    assert error.startswith("ksim-rl: error: ") and error.count("\n") == 1, error
    assert signs(place, error) == []
    after = sorted(str(path) for path in place.run.parent.rglob("*") if "__pycache__" not in str(path))
    assert after == before, "nothing is written"


EXPLODED = 10_000


@pytest.mark.parametrize("name", FAMILIES)
def test_a_payload_works_where_its_check_is_removed(name, place, capsys, monkeypatch):
    write, without = FAMILIES[name]
    without(monkeypatch)
    sizes = []
    monkeypatch.setattr(plain_data, "check_plain", lambda tree, where: sizes.append(len(str(tree))))
    command = write(place)
    call(command)
    error = capsys.readouterr().err
    found = signs(place, error)
    assert found or max(sizes, default=0) > EXPLODED, error


def test_there_are_families_over_every_kind_of_file():
    assert len(FAMILIES) + len(DATA_FILES) >= 12


# -- files that a config names ----------------------------------------------------------------------------------------


def pickled_motion(path, code):
    np.savez(path, fps=30.0, qpos=np.array([Bomb(code)], dtype=object), qvel=np.zeros(1))


def pickled_net(path, code):
    torch.save({"x": Bomb(code)}, path)


def with_pickled_arrays(monkeypatch):
    load = np.load
    monkeypatch.setattr(np, "load", lambda file, allow_pickle: load(file, allow_pickle=True))


DATA_FILES = {
    "motion": (pickled_motion, lambda path: motion._read(path), with_pickled_arrays),
    "actuator net": (pickled_net, lambda path: nets.NetFile(str(path), None), with_pickles),
}


@pytest.mark.parametrize("kind", DATA_FILES)
def test_data_files_hold_no_pickles(kind, place, monkeypatch):
    write, read, without = DATA_FILES[kind]
    path = place.run / "data.npz"
    write(path, place.code)
    with pytest.raises(ValueError, match=r"data\.npz"):
        read(path)
    assert signs(place, "") == []
    without(monkeypatch)
    with contextlib.suppress(ValueError, TypeError, AttributeError):
        read(path)
    assert signs(place, "") != []


@pytest.mark.parametrize("kind", DATA_FILES)
@pytest.mark.parametrize("special", ["pipe", "device", "too long"])
def test_data_files_are_files_of_a_size(kind, special, place, monkeypatch):
    path = place.run / "data.npz"
    if special == "pipe":
        os.mkfifo(path)
    elif special == "device":
        path.symlink_to("/dev/zero")
    else:
        with open(path, "wb") as file:
            file.truncate(plain_data.MOST_DATA_BYTES + 1)
    with pytest.raises(ValueError, match="no regular file|longer than"):
        DATA_FILES[kind][1](path)


def test_an_archive_that_unpacks_to_more_than_it_may_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(motion, "MOST_DATA_BYTES", 100_000)
    np.savez_compressed(tmp_path / "motion.npz", fps=30.0, qpos=np.zeros(100_000), qvel=np.zeros(1))
    with pytest.raises(ValueError, match="arrays are larger than 100000 bytes"):
        motion._read(tmp_path / "motion.npz")


@pytest.mark.parametrize("text", ["../../elsewhere", "a b", "", "x" * 200])
def test_the_id_of_a_run_is_no_path(tmp_path, text):
    (tmp_path / "run_id").write_text(text)
    with pytest.raises(ValueError, match=r"run_id"):
        loggers._kept_id(tmp_path / "run_id")


@pytest.mark.parametrize(
    "target",
    ["os.system", "builtins.eval", "ksim_rl.envs.make", "ksim_rl.trainers.run_folder.json", "pathlib.Path"],
)
def test_targets_are_classes_of_allowed_packages_and_never_functions(target):
    with pytest.raises(ValueError, match="_target_"):
        class_paths.find(target, "x", kind="dataclass", accepts=lambda value: True)


def test_a_place_to_write_to_is_taken_where_the_user_names_it(place, capsys):
    task = copy.deepcopy(place.tree["task"])
    task["sim"]["nan_guard"] = {"folder": "elsewhere"}
    command = place.write_config(task=task)
    assert call([*command, "task.sim.nan_guard.folder=mine"]) == 0, capsys.readouterr().err
    assert Path("mine").is_dir() and not Path("elsewhere").exists()


def test_a_folder_of_ones_own_is_trusted_where_the_user_says_so(place):
    task = copy.deepcopy(place.tree["task"])
    task["sim"]["nan_guard"] = {"folder": str(place.run / "nan")}
    place.write_checkpoint(task=task)
    assert call(["resume", str(place.run)]) == 2
    assert call(["resume", str(place.run), "--trust"]) == 0
    assert (place.run / "nan").is_dir()


def test_policies_are_loaded_without_a_folder_for_failures(place, monkeypatch):
    seen = []
    monkeypatch.setattr(run_folder, "build_env", lambda cfg, **_: seen.append(cfg) or pytest.skip.Exception)
    task = copy.deepcopy(place.tree["task"])
    task["sim"]["nan_guard"] = {"folder": str(place.outside / "written")}
    place.write_checkpoint({"observation_columns": {}}, task=task)
    with pytest.raises(Exception):  # noqa: B017
        run_folder.load_policy(place.run, device="cpu")
    assert seen[0].task.sim.nan_guard is None


def test_pickles_are_what_this_file_says():
    with pytest.raises(ZeroDivisionError):
        pickle.loads(pickle.dumps(Bomb("1 / 0")))
