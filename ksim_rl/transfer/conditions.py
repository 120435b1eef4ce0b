"""The conditions under which every policy is judged: one list, and none may be left out.

Each changes a task's config, and all else stays as in training: starts, commands and what the task itself draws.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import EventTerm
from ksim_rl.mdp.events import PushByVelocity, Ranges
from ksim_rl.mdp.randomization.bodies import RandomizeBodyCom, RandomizeBodyMass
from ksim_rl.mdp.randomization.friction import RandomizeGeomFriction
from ksim_rl.mdp.randomization.joints import (
    RandomizeActuatorGains,
    RandomizeEffortLimit,
    RandomizeEncoderBias,
)
from ksim_rl.scene.actuators import (
    Actuator,
    DCMotorActuator,
    IdealPDActuator,
    PositionActuator,
    without_delay,
)
from ksim_rl.scene.names import scalar_joint_ids
from ksim_rl.scene.scene import build_spec, scene_spec
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.trainers.other_physics import counts_substeps
from ksim_rl.transfer.changed_robot import GearedMotor, changed, entries, late
from ksim_rl.transfer.tilted_plane import TiltedPlane
from ksim_rl.transforms.noise.cfg import NoiseCfg, UniformNoise

Change = Callable[[ManagerBasedRlEnvCfg], ManagerBasedRlEnvCfg]
OFF = 0.2
"""How far masses, gains and limits are off."""
JITTER_S = 0.005
NO_LOAD_SPEED = 30.0
"""rad/s or m/s, of the DC motor, whose stall effort is the limit of the robot's own."""
ENCODER_BIAS = 0.03
SAG = 0.7
"""What an empty battery leaves of the limits of effort."""
SLOPE_DEG = 5.0
PUSHES: Ranges = {"x": (-0.8, 0.8), "y": (-0.8, 0.8), "yaw": (-1.0, 1.0)}


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A condition by its `name`, with a `change` of a task's config, which refuses tasks that have no such thing.

    `noise` says whether the sensors' noise is on, which evaluations leave out.
    """

    name: str
    change: Change
    noise: bool = False


def _as_trained(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
    return cfg


def _time_step(timestep: float) -> Change:
    """Return the change to another physics step; an env step lasts as long as before."""

    def change(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        step_s = cfg.decimation * _timestep(cfg)
        count = round(step_s / timestep)
        if count < 1 or abs(count * timestep - step_s) > 1e-9:
            raise ValueError(f"an env step of {step_s:g} s is no multiple of {timestep:g} s")
        if counts_substeps(cfg):
            raise ValueError("its actuators count their lags in physics steps")
        sim = dataclasses.replace(cfg.sim, timestep=timestep)
        return dataclasses.replace(cfg, sim=sim, decimation=count)

    return change


def _late_actions(delay_s: float) -> Change:
    """Return the change that makes actions arrive late, each episode by up to `JITTER_S` more or less."""

    def change(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        timestep = _timestep(cfg)
        # Whole steps inside of the range; one step at least is, unless steps are long.
        least = max(0, math.ceil((delay_s - JITTER_S) / timestep - 1e-9))
        most = math.floor((delay_s + JITTER_S) / timestep + 1e-9)
        if most < least:
            raise ValueError(f"{delay_s:g} s is no number of physics steps of {timestep:g} s")
        return _with_actuators(cfg, late((least, most)))

    return change


def _event(make: Callable[[ManagerBasedRlEnvCfg], EventTerm]) -> Change:
    """Return the change by an event that runs behind the task's own."""

    def change(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        return dataclasses.replace(cfg, events={**(cfg.events or {}), "card": make(cfg)})

    return change


def _friction(value: float) -> Change:
    return _event(
        lambda cfg: RandomizeGeomFriction(
            geoms=_rough_geoms(cfg), operation="abs", ranges={0: (value, value)}
        )
    )


def _rough_geoms(cfg: ManagerBasedRlEnvCfg) -> tuple[str, ...]:
    """Return the geoms that touch others with friction."""
    mj_model = build_spec(cfg.scene).compile()
    touches = (mj_model.geom_contype | mj_model.geom_conaffinity) != 0
    rough = np.flatnonzero(touches & (mj_model.geom_condim > 1))
    names = [mj_model.geom(int(geom)).name for geom in rough]
    found = tuple(name for name in names if name)
    none_touch = bool(mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT)
    if none_touch or not found:
        raise ValueError("nothing of it touches anything with friction")
    return found


def _masses(factor: float) -> Change:
    return _event(
        lambda cfg: RandomizeBodyMass(
            bodies=_bodies(cfg), operation="scale", ranges=(factor, factor)
        )
    )


def _centre(axis: int, share: float) -> Change:
    """Return the change that moves the root's centre of mass by a share of half its size."""

    def make(cfg: ManagerBasedRlEnvCfg) -> EventTerm:
        mj_model = build_spec(cfg.scene).compile()
        root = _root(mj_model)
        mass = float(mj_model.body_mass[root])
        # The box with the same inertia: its half edges squared are 3 / (2 m) times what the other axes have more.
        inertia_3 = mj_model.body_inertia[root]
        half_3 = np.sqrt(np.maximum(1.5 * (inertia_3.sum() - 2.0 * inertia_3) / mass, 0.0))
        # Principal axes lie near the body's own, in some order: the middle size is good enough for each of these.
        move = share * float(np.median(half_3))
        return RandomizeBodyCom(
            bodies=(mj_model.body(root).name,), operation="add", ranges={axis: (move, move)}
        )

    return _event(make)


def _gains(factor: float) -> Change:
    """Return the change of the gains of servos; of motors without any, of the effort that a command gives."""
    pair = (factor, factor)
    of_servos = _event(
        lambda cfg: RandomizeActuatorGains(joints=_driven(cfg), stiffness=pair, damping=pair)
    )

    def change(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        if _has_motors_alone(cfg):
            return _with_actuators(cfg, lambda motor: _scaled(motor, gain=factor))
        return of_servos(cfg)

    return change


def _limits(factor: float) -> Change:
    """Return the change of the limits of effort; of motors without any, of the range of their commands."""
    pair = (factor, factor)
    of_servos = _event(
        lambda cfg: RandomizeEffortLimit(joints=_driven(cfg), operation="scale", ranges=pair)
    )

    def change(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        if _has_motors_alone(cfg):
            return _with_actuators(cfg, lambda motor: _scaled(motor, limit=factor))
        return of_servos(cfg)

    return change


def _has_motors_alone(cfg: ManagerBasedRlEnvCfg) -> bool:
    return all(
        isinstance(entry, GearedMotor) for entry in entries(next(iter(cfg.scene.robots.values())))
    )


def _scaled(motor: Actuator, *, gain: float = 1.0, limit: float = 1.0) -> Actuator:
    assert isinstance(motor, GearedMotor)  # as `_has_motors_alone` found
    ends = None
    if motor.control_range is not None:
        low, high = motor.control_range
        ends = (limit * low, limit * high)
    most = None if motor.effort_limit is None else limit * motor.effort_limit
    if limit != 1.0 and ends is None and most is None:
        raise ValueError(f"nothing limits the motor of joint {motor.joints!r}")
    return dataclasses.replace(motor, gain=gain * motor.gain, control_range=ends, effort_limit=most)


def _actuators(kind: type[Actuator]) -> Change:
    """Return the change to another model of the servos, with their own gains and limits."""

    def swap(entry: Actuator) -> Actuator:
        inner = without_delay(entry)
        if not isinstance(inner, (IdealPDActuator, PositionActuator)):
            raise ValueError(f"its {type(inner).__name__} has no position servo")
        named = ("joints", "armature", "frictionloss", "effort_limit", "stiffness", "damping")
        same = {name: getattr(inner, name) for name in named}
        if kind is not DCMotorActuator:
            return kind(**same)
        if inner.effort_limit is None:
            raise ValueError("nothing limits the effort of its servos")
        return DCMotorActuator(
            **same, saturation_effort=inner.effort_limit, velocity_limit=NO_LOAD_SPEED
        )

    return lambda cfg: _with_actuators(cfg, swap)


def _noise(factor: float) -> Change:
    """Return the change that multiplies the noise of observations, and adds biases to encoders."""

    def change(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        observations = {}
        found = 0
        for name, group in cfg.observations.items():
            terms = {}
            for key, term in group.terms.items():
                if term.noise is None:
                    terms[key] = term
                else:
                    terms[key] = dataclasses.replace(term, noise=_louder(term.noise, factor))
                    found += 1
            observations[name] = dataclasses.replace(group, terms=terms)
        if not found:
            raise ValueError("its observations have no noise")
        louder = dataclasses.replace(cfg, observations=observations)
        bias = RandomizeEncoderBias(joints=_driven(cfg), ranges=(-ENCODER_BIAS, ENCODER_BIAS))
        return _event(lambda _: bias)(louder)

    return change


def _louder(noise: NoiseCfg, factor: float) -> NoiseCfg:
    if not isinstance(noise, UniformNoise):
        raise ValueError(f"its noise is a {type(noise).__name__}, and not uniform")

    def times(value: float | tuple[float, ...]) -> float | tuple[float, ...]:
        if isinstance(value, tuple):
            return tuple(factor * number for number in value)
        return factor * value

    # A bias of each episode, half as large as the noise.
    bias = UniformNoise(low=noise.low, high=noise.high)
    return dataclasses.replace(noise, low=times(noise.low), high=times(noise.high), bias=bias)


def _pushes(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
    _root(build_spec(cfg.scene).compile())
    push = PushByVelocity(interval_range_s=(3.0, 5.0), velocity_range=PUSHES)
    return _event(lambda _: push)(cfg)


def _slope(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
    terrain = cfg.scene.terrain
    if not isinstance(terrain, PlaneTerrain):
        raise ValueError("its ground is no plane")
    tilted = TiltedPlane(friction=terrain.friction, degrees=SLOPE_DEG)
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, terrain=tilted))


CONDITIONS: tuple[Condition, ...] = (
    Condition(name="as trained", change=_as_trained),
    Condition(name="time step 1 ms", change=_time_step(0.001)),
    Condition(name="time step 2 ms", change=_time_step(0.002)),
    Condition(name="time step 5 ms", change=_time_step(0.005)),
    Condition(name="actions 0 ms late, with jitter", change=_late_actions(0.0)),
    Condition(name="actions 10 ms late, with jitter", change=_late_actions(0.010)),
    Condition(name="actions 20 ms late, with jitter", change=_late_actions(0.020)),
    Condition(name="actions 40 ms late, with jitter", change=_late_actions(0.040)),
    Condition(name="friction 0.3", change=_friction(0.3)),
    Condition(name="friction 0.6", change=_friction(0.6)),
    Condition(name="friction 1.2", change=_friction(1.2)),
    Condition(name="masses 20 % less", change=_masses(1.0 - OFF)),
    Condition(name="masses 20 % more", change=_masses(1.0 + OFF)),
    Condition(name="centre of mass forward", change=_centre(0, OFF)),
    Condition(name="centre of mass backward", change=_centre(0, -OFF)),
    Condition(name="centre of mass to the left", change=_centre(1, OFF)),
    Condition(name="gains 20 % less", change=_gains(1.0 - OFF)),
    Condition(name="gains 20 % more", change=_gains(1.0 + OFF)),
    Condition(name="effort limits 20 % less", change=_limits(1.0 - OFF)),
    Condition(name="effort limits 20 % more", change=_limits(1.0 + OFF)),
    Condition(name="ideal PD motors", change=_actuators(IdealPDActuator)),
    Condition(name="DC motors with back-EMF", change=_actuators(DCMotorActuator)),
    Condition(name="MuJoCo's servos", change=_actuators(PositionActuator)),
    Condition(name="the training's sensor noise", change=_as_trained, noise=True),
    Condition(name="twice the noise, and biases", change=_noise(2.0), noise=True),
    Condition(name="pushes of 0.8 m/s", change=_pushes),
    Condition(name="a battery that is empty", change=_limits(SAG)),
    Condition(name="a slope of 5 degrees", change=_slope),
)
"""All of them, in the order of a card; the first is what the others are compared with."""


def _with_actuators(
    cfg: ManagerBasedRlEnvCfg, change: Callable[[Actuator], Actuator]
) -> ManagerBasedRlEnvCfg:
    name, robot = next(iter(cfg.scene.robots.items()))
    robots = {**cfg.scene.robots, name: changed(robot, change)}
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, robots=robots))


def _timestep(cfg: ManagerBasedRlEnvCfg) -> float:
    return float(scene_spec(cfg.scene, cfg.sim).option.timestep)


def _root(mj_model: mujoco.MjModel) -> int:
    """Return the body of the first free joint."""
    free = np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if not free.size:
        raise ValueError("its robot has no free root")
    return int(mj_model.jnt_bodyid[free[0]])


def _bodies(cfg: ManagerBasedRlEnvCfg) -> tuple[str, ...]:
    """Return the bodies that weigh something."""
    mj_model = build_spec(cfg.scene).compile()
    return tuple(mj_model.body(int(body)).name for body in np.flatnonzero(mj_model.body_mass > 0.0))


def _driven(cfg: ManagerBasedRlEnvCfg) -> tuple[str, ...]:
    """Return the joints with an actuator."""
    mj_model = build_spec(cfg.scene).compile()
    driven = set(mj_model.actuator_trnid[:, 0].tolist())
    return tuple(
        mj_model.joint(joint).name for joint in scalar_joint_ids(mj_model) if joint in driven
    )
