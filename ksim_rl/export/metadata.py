"""The description of an env for running its policy elsewhere: joints, terms, actions, limits."""

from collections.abc import Sequence

import numpy as np

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.export import controls
from ksim_rl.export.controls import joint_names
from ksim_rl.export.exported_transforms import TaskTransforms
from ksim_rl.export.standalone.description import CommandSpec, LawSpec, TermSpec
from ksim_rl.export.standalone.files import FORMAT, Json
from ksim_rl.export.traced_task import TracedTask
from ksim_rl.scene.names import drives_scalar_joint
from ksim_rl.scene.robots.proposal import effort_limit_of
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.state.joint_control import joint_control

NO_LIMIT = 1e30
"""What stands for no limit in the numbers of laws, which JSON cannot have as infinity."""


def metadata(
    ours: ManagerBasedRlEnv,
    terms: list[TermSpec],
    transforms: TaskTransforms,
    traced: TracedTask,
    commands: dict[str, CommandSpec],
) -> Json:
    """Return the description of the env, whose terms are traced.

    `terms` are those that the policy observes, `commands` as by `described_commands`. Raises NotDescribedError, naming
    the term, for an action or actuator.
    """
    cfg = ours.cfg
    view = ours.view
    actions = controls.actions(ours)
    laws = controls.actuators(ours)
    # Joints of the actions first, in their order; then the others, which observations may name.
    asked: list[str] = []
    for action in actions:
        if action["kind"] != "ctrl":
            asked += [name for name in action["names"] if name not in asked]
    names = [*asked, *(n for n in joint_names(view, None) if n not in asked)]
    # Controllers for mjlab's policies read the first entries, by these names.
    gains = _gains(ours, laws, names)
    if names:
        # The model's own pose: what events draw around it differs from world to world.
        by_term = [view.default_qpos_L[view.joints(n).qpos].tolist() for n in (asked, names)]
    else:
        by_term = [[], []]
    scales = []
    for action in actions:
        # One number may stand for all of an action's joints.
        scales += np.broadcast_to(action["scale"], len(action["names"])).tolist()
    sensors = {
        name: sensor
        for name, sensor in cfg.scene.sensors.items()
        if isinstance(sensor, ContactSensor)
    }
    return {
        "format": FORMAT,
        "joint_names": asked,
        "joint_stiffness": gains[0][: len(asked)],
        "joint_damping": gains[1][: len(asked)],
        "default_joint_pos": by_term[0],
        "action_scale": scales,
        "command_names": list(cfg.commands),
        "observation_names": [term["name"] for term in terms],
        "observation_history_lengths": [term["history_length"] for term in terms],
        "joints": {
            "names": names,
            "default_pos": by_term[1],
            "stiffness": gains[0],
            "damping": gains[1],
            "effort_scale": _effort_scales(ours, laws, names),
            "limits": {**_limits(ours, laws, names), "velocity": _no_load_speeds(laws, names)},
        },
        "observations": [{**term, "reads": traced.reads(term["name"])} for term in terms],
        "actions": actions,
        "action_chain": transforms.stages,
        "actuators": laws,
        "commands": commands,
        "contacts": {
            name: {
                "elements": [
                    f"{name}_{e}"
                    for e in s.elements(view.resolver.names("geom" if s.geoms else "body"))
                ],
                "strongest": s.reduce == "strongest",
                "every_substep": s.every_substep,
            }
            for name, s in sensors.items()
        },
        **traced.described(),
        "rewards": {
            name: {"weight": cfg.rewards[name].weight} for name in traced.scored["rewards"]
        },
        "terminations": {
            name: {"time_out": cfg.terminations[name].time_out}
            for name in traced.scored["terminations"]
        },
        "metrics": list(traced.scored["metrics"]),
        "left_out": list(traced.left_out),
        "scale_rewards_by_dt": cfg.scale_rewards_by_dt,
        "engine": ours.world.sim.engine,
        "physics_dt": ours.physics_dt,
        "decimation": cfg.decimation,
        "step_dt": ours.step_dt,
        "episode_steps": ours.max_episode_length
        if any(t.time_out for t in cfg.terminations.values())
        else 0,
        "encoders": "targets of positions are readings of encoders, as biased observations are: a robot's servos take "
        "them as they are. Only a simulation, whose servos see true positions, takes the encoders' bias off them",
        "frames": "x forward, y left, z up; quaternions (w, x, y, z); root velocities and gravity in its own axes",
    }


def _gains(
    ours: ManagerBasedRlEnv, laws: Sequence[LawSpec], names: Sequence[str]
) -> tuple[list[float], list[float]]:
    """Return stiffness and damping by joint: the numbers of laws, and the model's gains for MuJoCo's servos."""
    # Gains of servos are in the model, gains of laws in the numbers that the laws were given.
    model = ours.world.mj_model
    found = dict.fromkeys(names, (0.0, 0.0))
    # Joints that no action moves are held by their servos all the same.
    for actuator in range(model.nu):
        if not drives_scalar_joint(model, actuator):
            continue
        joint = model.joint(int(model.actuator_trnid[actuator, 0])).name
        control = joint_control(model, actuator)
        if joint in found and control.kind == "pos":
            found[joint] = (control.stiffness, control.damping)
    for law in laws:
        for k, (joint, actuator) in enumerate(zip(law["joints"], law["actuators"], strict=True)):
            control = joint_control(model, model.actuator(actuator).id)
            stiffness = control.stiffness
            damping = control.damping
            if "stiffness" in law["numbers"] and law["kind"] != "builtin":
                stiffness = law["numbers"]["stiffness"][k]
                damping = law["numbers"]["damping"][k]
            found[joint] = (stiffness, damping)
    stiffness_of = [found[name][0] for name in names]
    damping_of = [found[name][1] for name in names]
    return stiffness_of, damping_of


def _effort_scales(
    ours: ManagerBasedRlEnv, laws: Sequence[LawSpec], names: Sequence[str]
) -> list[float]:
    """Return the effort at the joint that one of a target of effort stands for, by joint: gear times gain of motors."""
    model = ours.world.mj_model
    found = dict.fromkeys(names, 1.0)
    for law in laws:
        # Laws of ours compute the effort at the joint.
        if law["kind"] != "builtin" or "effort" not in law["takes"]:
            continue
        for joint, name in zip(law["joints"], law["actuators"], strict=True):
            actuator = model.actuator(name).id
            gain = model.actuator_gainprm[actuator, 0]
            found[joint] = float(model.actuator_gear[actuator, 0] * gain)
    return [found[name] for name in names]


def _no_load_speeds(laws: Sequence[LawSpec], names: Sequence[str]) -> list[float | None]:
    """Return the speeds at which motors have no torque left, by joint; null where their model has none."""
    found: dict[str, float] = {}
    for law in laws:
        if "velocity_limit" in law["numbers"]:
            found |= zip(law["joints"], law["numbers"]["velocity_limit"], strict=True)
    return [found.get(name) for name in names]


def _limits(ours: ManagerBasedRlEnv, laws: Sequence[LawSpec], names: Sequence[str]) -> Json:
    """Return soft limits of position, and of effort at the joint, behind the gear; null where there is none."""
    model = ours.world.mj_model
    if names:
        limits = ours.view.joints(list(names)).soft_limits_L2.tolist()
    else:
        limits = []
    effort: dict[str, float] = {}
    for name in names:
        limit = effort_limit_of(model, model.joint(name).id, most=NO_LIMIT)
        if limit is not None:
            effort[name] = limit
    # Laws keep inside of theirs by themselves.
    for law in laws:
        for joint, limit in zip(
            law["joints"], law["numbers"].get("effort_limit", ()), strict=False
        ):
            if limit < NO_LIMIT:
                effort[joint] = min(limit, effort.get(joint, limit))
    finite = []
    for low, high in limits:
        # JSON has no infinity.
        edges = []
        for edge in (low, high):
            edges.append(edge if np.isfinite(edge) else None)
        finite.append(edges)
    return {"position": finite, "effort": [effort.get(name) for name in names]}
