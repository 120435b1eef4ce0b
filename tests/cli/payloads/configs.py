"""Payloads in config.yaml: Hydra's own part, and values of a run's fields."""

import copy
import json

import yaml
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from ksim_rl import conf
from ksim_rl.config import plain_data
from ksim_rl.trainers import run_cfg
from tests.cli.payloads.place import family


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


# -- config.yaml: Hydra's own part ------------------------------------------------------------------------------------


@family(without_the_check_of_config)
def callback(place):
    return place.write_config(
        hydra={"callbacks": {"x": {"_target_": "sympy.sympify", "a": place.expression}}}
    )


@family(without_the_check_of_config)
def handler_of_job_logging(place):
    handlers = {"x": {"()": "sympy.sympify", "a": place.expression}}
    return place.write_config(
        hydra={"job_logging": {"version": 1, "handlers": handlers, "root": {"handlers": ["x"]}}}
    )


@family(without_the_check_of_config)
def file_of_hydra_logging(place):
    handlers = {"x": {"class": "logging.FileHandler", "filename": str(place.outside / "written")}}
    logs = {"version": 1, "handlers": handlers, "root": {"handlers": ["x"]}}
    return place.write_config(hydra={"hydra_logging": logs, "verbose": False})


@family(without_the_check_of_config)
def folder_of_the_job(place):
    return place.write_config(hydra={"run": {"dir": str(place.outside / "written")}})[:3]


@family(without_the_check_of_config)
def variables_of_the_job(place):
    return place.write_config(hydra={"job": {"env_set": {"KSIM_RL_MARK": "1"}}})


@family(without_the_check_of_config)
def defaults_list(place):
    handlers = {"x": {"()": "sympy.sympify", "a": place.expression}}
    logs = {"version": 1, "handlers": handlers, "root": {"handlers": ["x"]}}
    evil = "# @package _global_\n" + yaml.safe_dump({"hydra": {"hydra_logging": logs}})
    (place.run / "evil.yaml").write_text(evil)
    return [*place.write_config(defaults=["launch", "evil", "_self_"]), "--help"]


# -- config.yaml: values ----------------------------------------------------------------------------------------------


def with_logger(place, **logger):
    return place.write_config(logger={**place.tree["logger"], **logger})


@family(without_the_check_of_config)
def interpolation_of_the_environment(place):
    return with_logger(place, wandb={"name": "${oc.env:KSIM_RL_SECRET}"})


@family(without_the_check_of_config)
def interpolation_of_a_key_elsewhere(place):
    hidden = "${oc.env:${logger.wandb.entity}}"
    return with_logger(place, wandb={"entity": "KSIM_RL_SECRET", "name": hidden})


@family(lambda monkeypatch: without_the_check_of_config(monkeypatch, unsafe_load))
def tag_of_an_object(place):
    return place.write_config(f"x: !!python/object/apply:eval [{json.dumps(place.code)}]\n")


@family(lambda monkeypatch: monkeypatch.setattr(plain_data, "check_events", lambda *_: None))
def exploding_anchors(place):
    lines = ["checkpoint: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [
        f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]" for level in range(1, 4)
    ]
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
        logger={
            **place.tree["logger"],
            "mlflow": {"tracking_uri": f"sqlite:///{place.outside}/written"},
        }
    )
    return ["resume", str(place.run)]
