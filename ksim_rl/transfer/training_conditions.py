"""Describes the conditions of a policy's training: physics, motors, noise, and the draws of events."""

import dataclasses

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.scene.actuators import Actuator, DelayedActuator
from ksim_rl.scene.scene import Robot, scene_spec
from ksim_rl.transfer.changed_robot import entries
from ksim_rl.transforms.groups.group_cfg import ObservationTermCfg


def training_conditions(cfg: ManagerBasedRlEnvCfg) -> dict[str, str]:
    """Return the conditions of a task's training, a line for each part.

    A part of the config is described by the fields that differ from their defaults.
    """
    timestep = float(scene_spec(cfg.scene, cfg.sim).option.timestep)
    found = {"physics": f"{cfg.decimation} steps of {1e3 * timestep:g} ms to an action"}
    found["motors"] = _motors(next(iter(cfg.scene.robots.values())))
    found["ground"] = "none" if cfg.scene.terrain is None else _told(cfg.scene.terrain)
    group = cfg.observations.get("actor")
    if group is not None:
        for name, term in group.terms.items():
            errors = _errors(term)
            if errors:
                found[f"observation {name}"] = errors
    for name, transform in cfg.transforms.items():
        found[f"transform {name}"] = _told(transform)
    for name, event in (cfg.events or {}).items():
        found[f"event {name}"] = _told(event)
    return found


def _motors(robot: Robot) -> str:
    """Return the kinds of a robot's motors, or why an actuator of its model is none of a joint."""
    try:
        kinds = dict.fromkeys(_motor(entry) for entry in entries(robot))
    except ValueError as error:
        return " ".join(str(error).split())
    return ", ".join(kinds)


def _motor(entry: Actuator) -> str:
    """Return the kind of a motor, with its delay, if it has one."""
    if not isinstance(entry, DelayedActuator):
        return type(entry).__name__
    late = f"{entry.min_lag} to {entry.max_lag} physics steps late"
    return f"{type(entry.actuator).__name__}, {late}"


def _errors(term: ObservationTermCfg) -> str:
    """Return the errors that training adds to the readings of a term."""
    parts = []
    if term.noise is not None:
        parts.append(_told(term.noise))
    if term.delay is not None:
        parts.append(_told(term.delay))
    return ", ".join(parts)


def _told(part: object) -> str:
    """Return the class of a part of a config, with the fields that differ from their defaults."""
    name = type(part).__name__
    if not dataclasses.is_dataclass(part):
        return name
    told = []
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if not _is_default(field, value):
            told.append(f"{field.name}={value!r}")
    return f"{name}({', '.join(told)})"


def _is_default(field: "dataclasses.Field[object]", value: object) -> bool:
    if field.default_factory is not dataclasses.MISSING:
        return value == field.default_factory()
    return field.default is not dataclasses.MISSING and value == field.default
