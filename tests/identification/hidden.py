"""A small robot with secret numbers on plain `mj_step`, much finer in time than what identifies it."""

from dataclasses import dataclass

import mujoco
import numpy as np

MODEL = """
<mujoco model="leg">
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <geom name="base" type="box" size="0.1 0.1 0.05" mass="5"/>
      <body name="thigh" pos="0 0.15 0">
        <joint name="hip" axis="0 1 0" range="-1.2 1.2" limited="true" armature="0.01"/>
        <geom name="thigh" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.8"/>
        <body name="shank" pos="0 0 -0.2">
          <joint name="knee" axis="0 1 0" range="-2.2 0.2" limited="true" armature="0.01"/>
          <geom name="shank" type="capsule" size="0.02" fromto="0 0 -0.03 0 0 -0.2" mass="0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" kp="20" kv="0.6" forcerange="-15 15"/>
    <position name="knee" joint="knee" kp="20" kv="0.6" forcerange="-15 15"/>
  </actuator>
  <keyframe><key name="stand" qpos="0 0 1 1 0 0 0 0.3 -0.8"/></keyframe>
</mujoco>
"""
JOINTS = ("hip", "knee")
PHYSICS_S = 0.0005


@dataclass(frozen=True, kw_only=True)
class Secret:
    """Numbers of both joints, in the order of `JOINTS`, and the delay, s."""

    armature: tuple[float, float] = (0.015, 0.007)
    damping: tuple[float, float] = (0.15, 0.08)
    frictionloss: tuple[float, float] = (0.3, 0.15)
    stiffness: tuple[float, float] = (24.0, 16.0)
    servo_damping: tuple[float, float] = (0.5, 0.75)
    torque_constant: tuple[float, float] = (0.9, 1.15)
    delay_s: float = 0.013


def hidden_model(secret: Secret) -> mujoco.MjModel:
    """Return the robot with its secret numbers, whose base is held."""
    spec = mujoco.MjSpec.from_string(MODEL)
    for element in [
        *spec.keys,
        *spec.actuators,
        *(joint for joint in spec.joints if not joint.name),
    ]:
        spec.delete(element)
    spec.option.timestep = PHYSICS_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    for place, name in enumerate(JOINTS):
        joint = spec.joint(name)
        joint.armature = secret.armature[place]
        joint.damping = [secret.damping[place], 0.0, 0.0]
        joint.frictionloss = secret.frictionloss[place]
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gainprm = [1.0, *[0.0] * 9]
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        motor.biasprm = [0.0, -secret.stiffness[place], -secret.servo_damping[place], *[0.0] * 7]
    return spec.compile()


def follow(secret: Secret, time_T: np.ndarray, targets: dict[str, np.ndarray]) -> np.ndarray:
    """Return the joints' true positions [T, 2] at the times of targets [T, 2], each held until the next."""
    model = hidden_model(secret)
    data = mujoco.MjData(model)
    data.qpos[:] = targets["pos"][0]
    control_TN = np.array(secret.stiffness) * targets["pos"]
    control_TN = control_TN + np.array(secret.servo_damping) * targets.get("vel", 0.0)
    control_TN = control_TN + np.array(secret.torque_constant) * targets.get("effort", 0.0)
    pos_TN = np.empty_like(control_TN)
    line = 0
    for step in range(round(time_T[-1] / PHYSICS_S) + 1):
        now = step * PHYSICS_S
        if now >= time_T[line] - 1e-9:
            pos_TN[line] = data.qpos
            line += 1
        arrived = np.searchsorted(time_T, now - secret.delay_s + 1e-9, side="right") - 1
        data.ctrl[:] = control_TN[max(arrived, 0)]
        mujoco.mj_step(model, data)
    return pos_TN


def log_text(time_T: np.ndarray, targets: dict[str, np.ndarray], pos_TN: np.ndarray) -> str:
    """Return a log as CSV."""
    columns = {"pos": "target_position", "vel": "target_velocity", "effort": "target_effort"}
    names = ["time", *(f"{joint}.position" for joint in JOINTS)]
    names += [f"{joint}.{columns[kind]}" for kind in targets for joint in JOINTS]
    rows = np.hstack((time_T[:, None], pos_TN, *targets.values()))
    return (
        "\n".join([",".join(names), *(",".join(f"{value:.9g}" for value in row) for row in rows)])
        + "\n"
    )
