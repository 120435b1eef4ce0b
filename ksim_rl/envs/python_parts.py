"""Lists the Python objects that a step of an env runs, by name, and those that are read only while it is built."""

from collections.abc import Iterator
from dataclasses import fields
from functools import partial
from typing import Any

from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from ksim_rl.compiled.python_states import PLAIN
from ksim_rl.compiled.python_values import Listed, Part, Parts, attributes_of
from ksim_rl.compiled.python_watch import Change
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import EventTerm, MetricTerm, RewardTerm, TerminationTerm

CFG = "cfg"
OPTIONS = "world.warp_model.opt"
_MANAGERS = (
    "event_manager",
    "command_manager",
    "action_manager",
    "observation_manager",
    "reward_manager",
    "termination_manager",
    "metric_manager",
    "curriculum_manager",
)
# Caches that change by themselves, notes of warnings that were given, and a flag that the device copies to the host
# after a step (`ActionManager`).
_CACHES = frozenset({"cache", "command_cache", "_has_warned", "_accepts_any", "_arrived"})
# TorchRL's own, of the keys of specs.
_KEYS_OF_SPECS = "_cache"
_OF_DRIVER = (
    "ground",
    "before_substep",
    "after_substep",
    "substep_sensors",
    "step_dt",
    "max_episode_length",
)
# Fields of terms that managers read when the env is built.
_READ_ONCE: tuple[tuple[type, frozenset[str], str], ...] = (
    (RewardTerm, frozenset({"weight"}), "write env.view.reward_weights[name] in place (`fill_`)"),
    (TerminationTerm, frozenset({"time_out"}), "build another env"),
    (MetricTerm, frozenset({"reduce", "per_substep"}), "build another env"),
    (EventTerm, frozenset({"mode"}), "build another env"),
)


def python_parts(env: EnvBase) -> dict[str, Part]:
    """Return the objects whose Python a step of the env runs: wrappers, transforms, terms and their managers.

    Terms have the names of the config, `rewards.alive`, and transforms the number of their place, the outermost first.
    """
    parts: dict[str, Part] = {}
    transforms: list[Transform] = []
    inner: EnvBase = env
    # From the outermost wrapper inwards.
    while isinstance(inner, TransformedEnv):
        parts[f"wrapper {len(parts)}"] = Listed(inner, partial(_of_wrapper, inner))
        transforms += _leaves(inner.transform)
        inner = inner.base_env
    # The number keeps two transforms of one class apart.
    for number, transform in enumerate(transforms):
        parts[f"transforms[{number}] {type(transform).__name__}"] = transform
    if isinstance(inner, ManagerBasedRlEnv):
        parts |= dict(terms(inner.cfg))
        parts |= _of_managers(inner)
    else:
        parts[type(inner).__name__] = inner
    return parts


def terms(cfg: ManagerBasedRlEnvCfg) -> Iterator[tuple[str, Part]]:
    """Yield the terms of a config by their names in it."""
    for group in cfg.observations.values():
        for name, observation in group.terms.items():
            yield f"observations.{name}", observation.term
    kinds = ("commands", "actions", "events", "rewards", "terminations", "metrics", "curriculum")
    for kind in kinds:
        for name, term in (getattr(cfg, kind) or {}).items():
            yield f"{kind}.{name}", term


def why_not(change: Change) -> str | None:
    """Return advice for a change that has no effect on an env that is built already; None where it has one."""
    if all(name.startswith(f"{CFG}.") for name in change.names):
        return "an env reads its config once: build another one (`dataclasses.replace`)"
    if all(name.startswith(f"{OPTIONS}.") for name in change.names):
        return "a world reads its options once: give them by `sim` of the config"
    for kind, once, instead in _READ_ONCE:
        if isinstance(change.owner, kind) and change.key in once:
            return f"an env reads it once: {instead}"
    return None


def _leaves(transform: Any) -> list[Transform]:
    if not isinstance(transform, Compose):
        return [transform]
    return [leaf for part in transform.transforms for leaf in _leaves(part)]


def _of_wrapper(wrapper: TransformedEnv) -> Parts:
    own = {name: value for name, value in attributes_of(wrapper).items() if name != _KEYS_OF_SPECS}
    return own | {"transform": wrapper.transform}


def _of_managers(env: ManagerBasedRlEnv) -> Parts:
    """Return the objects that call the terms of an env, and the values other than tensors that they read."""
    driver = env.driver
    parts = {
        "env": Listed(env, partial(_of_env, env)),
        "view": Listed(env.view, partial(_public, env.view)),
        # Only these: the rest of the driver are tensors, or parts that are listed on their own.
        "driver": Listed(driver, lambda: {name: getattr(driver, name) for name in _OF_DRIVER}),
        # The code of a config does not run in a step, only its values count.
        CFG: Listed(env.cfg, partial(_read_once, env), reads_code=False),
    }
    for name, (owner, read) in env.world.recorded_python().items():
        parts[name] = Listed(owner, read if name != OPTIONS else partial(_plain, owner))
    for name in _MANAGERS:
        manager = getattr(env, name)
        parts[name] = Listed(manager, partial(_without_caches, manager))
    return parts


def _of_env(env: ManagerBasedRlEnv) -> Parts:
    # The config is a separate part, since most of its fields are read once.
    left_out = ("cfg", _KEYS_OF_SPECS)
    own = {name: value for name, value in attributes_of(env).items() if name not in left_out}
    # The one field of the config that each step reads.
    return own | {"cfg.decimation": env.cfg.decimation}


def _read_once(env: ManagerBasedRlEnv) -> Parts:
    """Return the fields of the config that are read while the env is built; seeds are given it later, too."""
    names = {field.name for field in fields(env.cfg)} - {"decimation", "seed", "viewer"}
    return {name: getattr(env.cfg, name) for name in sorted(names)}


def _public(owner: Part) -> Parts:
    return {name: value for name, value in _without_caches(owner).items() if name[0] != "_"}


def _without_caches(owner: Part) -> Parts:
    return {name: value for name, value in vars(owner).items() if name not in _CACHES}


def _plain(owner: Part) -> Parts:
    return {name: value for name, value in vars(owner).items() if issubclass(type(value), PLAIN)}
