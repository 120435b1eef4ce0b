"""Random states that both engines start from: the same float32 numbers, and no warm start."""

import dataclasses

import mujoco
import numpy as np

from ksim_rl.physics import poses

SETTLE_STEPS = 150
CTRL_EVERY = 50


@dataclasses.dataclass(frozen=True)
class States:
    """Poses, velocities and controls of E worlds, each [E, ...] float32."""

    qpos_EL: np.ndarray
    qvel_EL: np.ndarray
    ctrl_EL: np.ndarray

    def put(self, mj_data: mujoco.MjData, row: int) -> None:
        """Start the C engine at the state of one world."""
        mujoco.mj_resetData(mj_data.model, mj_data)
        mj_data.qpos[:] = self.qpos_EL[row]
        mj_data.qvel[:] = self.qvel_EL[row]
        mj_data.ctrl[:] = self.ctrl_EL[row]
        mj_data.qacc_warmstart[:] = 0.0


def _rounded(rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> States:
    return States(*(np.stack(column).astype(np.float32) for column in zip(*rows, strict=True)))


def anywhere(mj_model: mujoco.MjModel, num_worlds: int, *, seed: int) -> States:
    """Any pose, velocities of about 1 rad/s or m/s, any control: for models that touch nothing."""
    rng = np.random.default_rng(seed)
    qpos_EL = poses.random_qpos(mj_model, num_worlds, rng)
    return _rounded(
        [(qpos, rng.normal(size=mj_model.nv), poses.random_ctrl(mj_model, rng)) for qpos in qpos_EL]
    )


def in_contact(mj_model: mujoco.MjModel, num_worlds: int, *, spread: float, seed: int) -> States:
    """Robots that stand, stagger and fall.

    From the first keyframe, tilted and with the joints off by about 0.1 rad, the C engine runs 150 steps; the controls
    jump by about `spread` every 50 steps.
    """
    rng = np.random.default_rng(seed)
    mj_data = mujoco.MjData(mj_model)
    rows = []
    for _ in range(num_worlds):
        mujoco.mj_resetDataKeyframe(mj_model, mj_data, 0)
        home = mj_data.ctrl.copy()
        for joint in range(mj_model.njnt):
            adr = mj_model.jnt_qposadr[joint]
            if mj_model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                mj_data.qpos[adr + 3 : adr + 7] = _tilted(mj_data.qpos[adr + 3 : adr + 7], rng)
            else:
                mj_data.qpos[adr] += 0.1 * rng.normal()
        poses.put_in_ground(mj_model, mj_data, depth=0.0)
        for step in range(SETTLE_STEPS):
            if step % CTRL_EVERY == 0:
                mj_data.ctrl[:] = home + spread * rng.normal(size=mj_model.nu)
            mujoco.mj_step(mj_model, mj_data)
        rows.append((mj_data.qpos.copy(), mj_data.qvel.copy(), mj_data.ctrl.copy()))
    return _rounded(rows)


def thrown(mj_model: mujoco.MjModel, num_worlds: int, *, seed: int) -> States:
    """Things that tumble and lie: from any pose on the ground, 20 to 200 steps under any control up to 1."""
    rng = np.random.default_rng(seed)
    mj_data = mujoco.MjData(mj_model)
    rows = []
    for qpos in poses.random_qpos(mj_model, num_worlds, rng):
        mujoco.mj_resetData(mj_model, mj_data)
        mj_data.qpos[:] = qpos
        poses.put_in_ground(mj_model, mj_data, depth=0.0)
        mj_data.ctrl[:] = np.clip(poses.random_ctrl(mj_model, rng), -1.0, 1.0)
        mujoco.mj_step(mj_model, mj_data, int(rng.integers(20, 200)))
        rows.append((mj_data.qpos.copy(), mj_data.qvel.copy(), mj_data.ctrl.copy()))
    return _rounded(rows)


def _tilted(quat: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Turn an orientation by up to 0.5 rad about a random axis."""
    axis = rng.normal(size=3)
    turn, turned = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, axis / np.linalg.norm(axis), rng.uniform(0.0, 0.5))
    mujoco.mju_mulQuat(turned, quat, turn)
    return turned
