"""Robots under their default targets on a plane, in MuJoCo's C engine."""

import re

import mujoco
import numpy as np

from ksim_rl.scene.scene import SceneCfg, build_spec
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.tasks import velocity
from tests.scene.robots.reference import loaded_spec


def on_a_plane(robot):
    """Return the compiled model of a robot on a plane with the physics of the velocity tasks, or skip."""
    loaded_spec(robot)
    spec = build_spec(SceneCfg(robots={"robot": robot}, terrain=PlaneTerrain()))
    velocity.sim().apply_to(spec)
    return spec.compile()


def stand(robot, model, *, seconds, lift=0.02):
    """Drop the robot from `lift` m in its default pose, let it hold that pose, and return the data.

    Plain motors get the torque of a PD controller with the gains of the robot's own `actuators`.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] += lift
    target = data.qpos.copy()
    motors = _pd_gains(robot, model)
    for _ in range(round(seconds / model.opt.timestep)):
        for actuator, (qpos, dof, stiffness, damping, limit) in motors.items():
            effort = stiffness * (target[qpos] - data.qpos[qpos]) - damping * data.qvel[dof]
            data.ctrl[actuator] = np.clip(effort, -limit, limit)
        mujoco.mj_step(model, data)
    return data


def uprightness(data, body):
    """Return the cosine of a body's tilt."""
    return data.body(body).xmat[8]


def _pd_gains(robot, model):
    gains = {}
    for entry in getattr(robot, "actuators", ()):
        if not entry.is_explicit:
            continue
        for index in range(model.nu):
            joint = model.joint(model.actuator_trnid[index, 0])
            if any(re.fullmatch(pattern, joint.name) for pattern in entry.joints):
                address = int(joint.qposadr[0]), int(joint.dofadr[0])
                gains[index] = (*address, entry.stiffness, entry.damping, entry.effort_limit)
    return gains
