"""Describes as plain data how an env changes observations and actions: noise, lags, targets, motors."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from ksim_rl import mdp
from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.view import EnvView
from ksim_rl.export.exported_transforms import lag
from ksim_rl.export.refusal import NotDescribedError
from ksim_rl.export.standalone.description import (
    ActionSpec,
    ControlSpec,
    Edges,
    JointActionSpec,
    LawSpec,
    NoiseSpec,
    TermSpec,
)
from ksim_rl.mdp.actions import per_joint
from ksim_rl.scene.actuators import (
    Actuator,
    DCMotorActuator,
    DelayedActuator,
    IdealPDActuator,
)
from ksim_rl.scene.actuators.builtin import BuiltinActuator
from ksim_rl.scene.actuators.joint_drives import driven_joints
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.joint_control import TargetKind
from ksim_rl.transforms import DelayCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, history_cfg
from ksim_rl.transforms.low_pass import smoothing
from ksim_rl.transforms.noise.cfg import NoiseCfg, per_dim


def joint_names(view: EnvView, patterns: Patterns | None) -> list[str]:
    """Return the names of the hinges and slides that some patterns match, in the order of the patterns."""
    return list(view.joints(patterns).names)


def noise(cfg: NoiseCfg | None, size: int) -> NoiseSpec | None:
    """Return the description of a noise on `size` numbers; `by_level` counts as full."""
    if cfg is None:
        return None
    # As offset + spread * draw, with one number per column: ranges and stds have the same form then.
    offset, spread = cfg.affine(size)
    if cfg.is_gaussian:
        draw = "gaussian"
    elif any(spread):
        draw = "uniform"
    else:
        draw = "none"
    return {
        "draw": draw,
        "offset": offset,
        "spread": spread,
        "operation": cfg.operation,
        "bias": noise(cfg.bias, size),
        # Zeros stand for no walk and no rounding, so the runner needs no special case.
        "walk_std": per_dim("walk_std", cfg.walk_std, size),
        "resolution": per_dim("resolution", cfg.resolution, size),
        "dropout": cfg.dropout,
        "lost": cfg.lost,
    }


def observations(env: ManagerBasedRlEnv, groups: Sequence[str]) -> list[TermSpec]:
    """Return the processing of each term's readings, in the order in which a policy reads the terms."""
    found: list[TermSpec] = []
    for group in groups:
        cfg: ObservationGroupCfg = env.cfg.observations[group]
        for name, term in cfg.terms.items():
            # Size of one frame, before history.
            size = env.observation_spec["obs", name].shape[-1]
            low, high = term.clip or (None, None)
            # A term's own history or lag takes the place of its group's; a group's lag is shared by its
            # terms.
            frames = history_cfg(term.history if term.history is not None else cfg.history)
            delay = lag(term.delay) or lag(cfg.delay, shared=group)
            found.append(
                {
                    "name": name,
                    "size": size,
                    "noise": noise(term.noise if cfg.enable_noise else None, size),
                    "clip": [low, high],
                    "scale": per_dim("scale", term.scale, size),
                    "delay": delay,
                    "history_length": frames.length if frames else 1,
                    "history_stride": frames.stride if frames else 1,
                }
            )
    return found


def actions(env: ManagerBasedRlEnv) -> list[ActionSpec]:
    """Return the meaning of an action's columns, by name of the joint or actuator.

    Raises NotDescribedError, naming the term, for one of a kind that this room does not know.
    """
    found: list[ActionSpec] = []
    start = 0
    # Terms take their columns of an action in the order of the config.
    for name, term in env.cfg.actions.items():
        stop = start + env.action_manager.sizes[name]
        found.append(_action(term, name, [start, stop], env.view))
        start = stop
    return found


def _action(term: Any, name: str, columns: list[int], view: EnvView) -> ActionSpec:
    kinds: dict[type, TargetKind] = {
        mdp.JointPositionAction: "pos",
        mdp.JointPositionVelocityAction: "pos",
        mdp.RelativeJointPositionAction: "pos",
        mdp.JointVelocityAction: "vel",
        mdp.JointEffortAction: "effort",
    }
    # Controls are written as they are, without a joint's target in between.
    if type(term) is mdp.ActuatorAction:
        every = view.resolver.names("actuator")
        names = [every[i] for i in view.resolver.ids("actuator", term.actuators)]
        limits_K2 = view.ctrl_limits_L2[view.resolver.index("actuator", term.actuators)]
        low, high = limits_K2.T.tolist()
        scale, offset = (_plain(term.numbers(view, field)) for field in ("scale", "offset"))
        return ControlSpec(
            name=name,
            columns=columns,
            kind="ctrl",
            names=names,
            limits=(low, high),
            clip=None,
            tanh=False,
            scale=scale,
            offset=offset,
            alpha=None,
        )
    # Exact types: a subclass may compute something else.
    if type(term) not in kinds:
        raise NotDescribedError(f"task.actions.{name}: {type(term).__name__} has no description")
    names = joint_names(view, term.joints)
    kind = kinds[type(term)]
    if term.cutoff_hz:
        # First-order filter: the share of the difference that one env step takes.
        alpha = smoothing(term.cutoff_hz, view.step_dt)
    else:
        alpha = None
    offset = _numbers(view, term, "offset")
    from_default = getattr(term, "use_default_offset", False)
    # The model's own pose: what events draw around it differs from world to world.
    if from_default:
        default = view.default_qpos_L[view.joints(term.joints).qpos].tolist()
        offset = [a + b for a, b in zip(offset, default, strict=True)]
    # Positions and velocities are not limited here: servos and joints have limits of their own. JSON has no infinity.
    limits: Edges = (-1e30, 1e30)
    if kind == "effort":
        limits_K2 = view.targets.limits("effort", term.joints)
        if limits_K2 is not None:
            low, high = limits_K2.T.tolist()
            limits = (low, high)
    found: JointActionSpec = {
        "name": name,
        "columns": columns,
        "kind": kind,
        "names": names,
        "relative": isinstance(term, mdp.RelativeJointPositionAction),
        "from_default": from_default,
        "limits": limits,
        "clip": term.clip,
        "tanh": term.tanh,
        "alpha": alpha,
        "scale": _numbers(view, term, "scale"),
        "offset": offset,
    }
    if isinstance(term, mdp.JointPositionVelocityAction):
        # The velocity half has no offset: its rest is 0 rad/s.
        found["velocity"] = {
            "clip": term.clip,
            "tanh": term.tanh,
            "alpha": alpha,
            "scale": _numbers(view, term, "velocity_scale"),
            "offset": 0.0,
        }
    return found


def _plain(numbers: float | Tensor) -> float | list[float]:
    """Return numbers for JSON."""
    if isinstance(numbers, Tensor):
        return numbers.tolist()
    return numbers


def _numbers(view: EnvView, term: Any, field: str) -> list[float]:
    value: Any = per_joint(view, field, getattr(term, field), term.joints)
    if isinstance(value, float):
        return [value] * len(view.joints(term.joints))
    return value.tolist()


def actuators(env: ManagerBasedRlEnv) -> list[LawSpec]:
    """Return the drives of joints that have targets: laws that run before each substep, or MuJoCo's servos."""
    found: list[LawSpec] = []
    view = env.view
    # Joints that a law of ours drives; the others are left to MuJoCo's servos.
    explicit: set[str] = set()
    for name, robot in env.cfg.scene.entities.items():
        prefix = view.entity(name).prefix
        # Actuators are given by names in the robot's own file, joints of the scene have its prefix.
        own = [n.removeprefix(prefix) for n in joint_names(view, None) if n.startswith(prefix)]
        for actuator, driven in driven_joints(getattr(robot, "actuators", ()), own):
            joints = [prefix + joint for joint in driven]
            if actuator.is_explicit:
                found.append(_law(actuator, joints, view))
                explicit |= set(joints)
    kinds: tuple[TargetKind, ...] = ("pos", "vel", "effort")
    for kind in kinds:
        # Position and velocity of one joint may be driven by two servos of the model.
        joints = [
            n
            for spec in actions(env)
            if spec["kind"] == kind or (kind == "vel" and "velocity" in spec)
            for n in spec["names"]
            if n not in explicit
        ]
        if joints:
            names, scale, offset = _of_actuators(view, joints, kind)
            found.append(
                {
                    "joints": joints,
                    "kind": "builtin",
                    "takes": [kind],
                    "numbers": {},
                    "delay": None,
                    "actuators": names,
                    "scale": scale,
                    "offset": offset,
                }
            )
    return found


def _law(actuator: Actuator, joints: list[str], view: EnvView) -> LawSpec:
    delay = None
    # The lag is in substeps, as the law runs before each of them.
    if isinstance(actuator, DelayedActuator):
        delay = lag(DelayCfg(min_lag=actuator.min_lag, max_lag=actuator.max_lag))
        actuator = actuator.actuator
    kinds = {IdealPDActuator: "ideal_pd", DCMotorActuator: "dc_motor"}
    if isinstance(actuator, BuiltinActuator):
        kind = "builtin"
    else:
        kind = kinds.get(type(actuator))
    if kind is None:
        raise NotDescribedError(
            f"actuator {type(actuator).__name__} of {joints[0]!r} has no description: an export takes MuJoCo's "
            "actuators, IdealPDActuator and DCMotorActuator, delayed or not"
        )
    # JSON has no infinity.
    numbers = {n: [min(value, 1e30)] * len(joints) for n, value in actuator.params.items()}
    names, scale, offset = _of_actuators(view, joints, None)
    return {
        "kind": kind,
        "joints": joints,
        # Sorted, since a set has no order: the runner joins delayed targets in this one.
        "takes": sorted(actuator.takes),
        "numbers": numbers,
        "actuators": names,
        "scale": scale,
        "offset": offset,
        "delay": delay,
    }


def _of_actuators(
    view: EnvView, joints: Sequence[str], kind: TargetKind | None
) -> tuple[list[str], list[float], list[float]]:
    """Return the actuators that take this kind of target, and the scales and offsets that make controls of targets.

    Without a kind they are the motors of laws, one of each joint, whose controls are the laws' own.
    """
    every = joint_names(view, None)
    names = view.resolver.names("actuator")
    driven: list[str] = []
    scales: list[float] = []
    offsets: list[float] = []
    for joint in joints:
        # `driven` and `motor` take the number of a joint among all of the scene.
        number = every.index(joint)
        if kind is None:
            actuator = view.targets.motor(number)
            scale = 1.0
            offset = 0.0
        else:
            actuator, control = view.targets.driven(kind, number)
            scale = control.scale
            offset = control.offset
        driven.append(names[actuator])
        scales.append(scale)
        offsets.append(offset)
    return driven, scales, offsets
