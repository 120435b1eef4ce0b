"""Worlds at random states, and what MuJoCo's C engine says about them."""

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from tests.mdp.bench import Bench

E = 16
FREE, SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
BODY, SITE = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_SITE
FIXED_BASE = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body name="turret" pos="0.3 -0.2 0.7" quat="0.8 0.1 0.5 -0.3">
      <joint name="pan" axis="0.2 0.1 1" pos="0.05 0 0"/>
      <geom name="turret" type="box" size="0.1 0.2 0.3" pos="0.1 0 0.2" mass="1.5"/>
      <site name="eye" pos="0.2 0.1 0"/>
      <body name="wrist" pos="0 0.1 0.4">
        <joint name="ball" type="ball"/>
        <geom name="wrist" type="sphere" size="0.05" mass="0.4"/>
        <body name="rod" pos="0.1 0 0.1">
          <joint name="reach" type="slide" axis="1 1 0" range="-0.2 0.6" limited="true"/>
          <geom name="rod" type="capsule" size="0.02 0.2" mass="0.7" contype="0" conaffinity="0"/>
          <site name="tip" pos="0 0 0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="pan" joint="pan"/><motor name="reach" joint="reach"/></actuator>
  <sensor><gyro name="gyro" site="tip"/><framepos name="tip" objtype="site" objname="tip"/></sensor>
</mujoco>
"""
"""A turret whose ball joint stands between its hinge and its slide, so that their addresses are not contiguous."""


def random_bench(source: str) -> Bench:
    """Put worlds at random states, ball and free joints at random orientations."""
    bench = Bench(source, E, {}, soft_joint_pos_limit_factor=0.5)
    rng = np.random.default_rng(0)
    model = bench.world.mj_model
    qpos = rng.uniform(-0.2, 0.5, (E, model.nq))
    qvel = rng.normal(0.0, 1.5, (E, model.nv))
    for row in qpos:
        for joint in np.flatnonzero(model.jnt_type < SLIDE):
            start = model.jnt_qposadr[joint] + (3 if model.jnt_type[joint] == FREE else 0)
            turn = rng.normal(size=4)
            row[start : start + 4] = turn / np.linalg.norm(turn)
    bench.place(qpos, qvel)
    return bench


def engine(bench: Bench, read: Callable[[Any, Any], Any]) -> Tensor:
    """Return what `read(model, data)` gives after `mj_forward` at each row's state, float32 [E, ...]."""
    model, data = bench.world.mj_model, mujoco.MjData(bench.world.mj_model)
    rows = []
    for qpos, qvel in zip(bench.world.qpos_EL.double(), bench.world.qvel_EL.double(), strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        rows.append(np.array(read(model, data)))
    return torch.tensor(np.stack(rows), dtype=torch.float32)


def velocity(
    model: Any, data: Any, ids: Sequence[int], *, part: str, kind: Any = BODY
) -> np.ndarray:
    """Return world-frame velocities of frame origins, [N, 3], from `mj_objectVelocity`: (angular, linear)."""
    result, six = [], np.zeros(6)
    for i in ids:
        mujoco.mj_objectVelocity(model, data, kind, i, six, 0)
        result.append(six[:3].copy() if part == "angular" else six[3:].copy())
    return np.stack(result)


def scalar_joints(model: Any) -> np.ndarray:
    """Return the ids of hinges and slides."""
    return np.flatnonzero(model.jnt_type >= SLIDE)


def close(actual: Tensor, expected: Tensor) -> None:
    """Compare within float32 round-off."""
    torch.testing.assert_close(actual, expected, atol=2e-5, rtol=2e-5)
