"""This module makes the choices of the config groups from the dataclasses, where each default stands."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, get_type_hints

from hydra.core.config_store import ConfigStore

from ksim_rl import algorithms
from ksim_rl.algorithms.off_policy import FEW_ENVS, MANY_ENVS
from ksim_rl.algorithms.ppo import DATA
from ksim_rl.config import upstream
from ksim_rl.config.config_tree import default_tree, to_tree
from ksim_rl.modules import ActorCfg, CriticCfg, RecurrentCfg, SharedTrunkCfg
from ksim_rl.trainers import Algorithm, ModulesCfg, RunCfg
from ksim_rl.trainers.loggers import LoggerCfg, MLflowCfg, WandbCfg

HINTS = get_type_hints(RunCfg)
DEFAULTS = default_tree(RunCfg)


def _with_memory(memory: RecurrentCfg) -> ModulesCfg:
    return ModulesCfg(recurrent_actor=memory, recurrent_critic=memory)


# By group and name. The data and networks of an algorithm that are none of these go by its own name.
CHOICES: dict[str, dict[str, Any]] = {
    "data": {"on_policy": DATA, "off_policy": MANY_ENVS, "off_policy_small": FEW_ENVS},
    "modules": {
        "mlp": ModulesCfg(),
        "gru": _with_memory(RecurrentCfg(kind="gru")),
        "lstm": _with_memory(RecurrentCfg(kind="lstm")),
        "shared_trunk": ModulesCfg(
            trunk=SharedTrunkCfg(),
            # The trunk normalizes.
            actor=ActorCfg(in_keys=("features",), hidden_dims=(128,), obs_normalization=False),
            critic=CriticCfg(in_keys=("features",), hidden_dims=(128,), obs_normalization=False),
        ),
    },
    "logger": {
        "local": LoggerCfg(),
        "none": LoggerCfg(csv=False, tensorboard=False),
        "wandb": LoggerCfg(tensorboard=False, wandb=WandbCfg()),
        "mlflow": LoggerCfg(tensorboard=False, mlflow=MLflowCfg()),
    },
}


def store_choices() -> None:
    """Store what each group offers, in `objective` the algorithms, and `run`, the fields of no group."""
    alone = ("task_name", "num_envs", "seed", "device", "checkpoint")
    ConfigStore.instance().store(name="run", node={name: DEFAULTS[name] for name in alone})
    upstream.store_config("collector", "rollout", lambda: DEFAULTS["collector"])
    upstream.store_config("trainer", "on_policy", lambda: DEFAULTS["trainer"])
    choices = {group: dict(own) for group, own in CHOICES.items()}
    for name in algorithms.names():
        algorithm = algorithms.algorithm(name)
        chosen = {group: _name_of(group, algorithm) for group in ("data", "modules")}
        for group, choice in chosen.items():
            choices[group].setdefault(choice, getattr(algorithm, group))
        upstream.store_config("objective", name, partial(_objective, algorithm, chosen))
    for group, own in choices.items():
        for name, cfg in own.items():
            upstream.store_config(group, name, _maker(group, cfg))


def _maker(group: str, cfg: Any) -> Callable[[], dict[str, Any]]:
    return lambda: to_tree(cfg, HINTS[group])


def _name_of(group: str, algorithm: Algorithm) -> str:
    cfg = {"data": algorithm.data, "modules": algorithm.modules}[group]
    return next((name for name, choice in CHOICES[group].items() if choice == cfg), algorithm.name)


def _objective(algorithm: Algorithm, chosen: Mapping[str, str]) -> dict[str, Any]:
    overrides = [{f"override /{group}@_global_.{group}": name} for group, name in chosen.items()]
    return {"defaults": ["_self_", *overrides], **default_tree(algorithm.cfg, HINTS["objective"])}
