"""One world of a small model and the C engine, from the same state, and how far apart they are."""

import copy
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World

STATE = ("qpos", "qvel", "act", "qacc", "act_dot", "actuator_force", "qfrc_actuator")
ACCELERATION_STAGE = int(mujoco.mjtStage.mjSTAGE_ACC)
# Our kernels, MuJoCo Warp's kernels with our solver, and MuJoCo Warp alone, each solved to rounding.
KERNELS = {
    "ours": SimCfg(one_kernel_dynamics=True, tolerance=1e-8, iterations=50),
    "our solver": SimCfg(one_kernel_dynamics=False, tolerance=1e-8, iterations=50),
    "theirs": SimCfg(one_kernel_solver=False, tolerance=1e-8, iterations=50),
}
# MuJoCo Warp's solver compiles kernels of its own for each model. Where the same is asked of ours, it is a long test;
# test_idle_ties, test_asleep, test_split_substeps and test_every_field ask it always.
THEIRS = pytest.param("theirs", marks=pytest.mark.full)
ALL_KERNELS = ("ours", "our solver", THEIRS)


def started(
    xml: str | mujoco.MjModel,
    sim: SimCfg,
    *,
    fields: Mapping[str, np.ndarray] | None = None,
    seed: int = 0,
    spread: float = 0.3,
    speed: float = 1.0,
) -> tuple[World, mujoco.MjData, mujoco.MjModel]:
    """Return two worlds in one random state, and C's data and model of the second, which has fields of its own."""
    fields = fields or {}
    mj_model = mujoco.MjModel.from_xml_string(xml) if isinstance(xml, str) else xml
    world = World(mj_model, num_envs=2, sim=sim, per_world_fields=tuple(fields))
    in_c = copy.copy(world.mj_model)
    for name, value in fields.items():
        world.field(name)[1] = torch.as_tensor(value, dtype=torch.float32).reshape(
            world.field(name)[1].shape
        )
        getattr(in_c, name)[:] = value
    if fields:
        world.set_const(tuple(fields))
        mujoco.mj_setConst(in_c, mujoco.MjData(in_c))
    mj_data = mujoco.MjData(in_c)
    generator = np.random.default_rng(seed)
    mujoco.mj_integratePos(in_c, mj_data.qpos, generator.uniform(-spread, spread, in_c.nv), 1.0)
    mj_data.qvel[:] = generator.uniform(-speed, speed, in_c.nv)
    mj_data.ctrl[:] = generator.uniform(-1.0, 1.0, in_c.nu)
    mj_data.act[:] = generator.uniform(0.0, 0.5, in_c.na)
    for name in ("qpos", "qvel", "ctrl", "act"):
        world.view(name).copy_(torch.from_numpy(getattr(mj_data, name)).float())
    return world, mj_data, in_c


def check(
    world: World, mj_data: mujoco.MjData, names: Sequence[str] = STATE, *, tolerance: float = 3e-4
) -> None:
    """Compare arrays of the second world with C's."""
    for name in names:
        found = world.view(name)[1].numpy()
        expected = np.asarray(getattr(mj_data, name)).reshape(found.shape)
        scale = max(1.0, float(np.abs(expected).max(initial=0.0)))
        np.testing.assert_allclose(found, expected, atol=tolerance * scale, err_msg=name)


def check_sensors(
    world: World, mj_data: mujoco.MjData, *, of_forces: bool, tolerance: float = 3e-4
) -> None:
    """Compare the sensors that forces decide, or the others, of the second world with C's."""
    mj_model = world.mj_model
    for sensor in range(mj_model.nsensor):
        if (mj_model.sensor_needstage[sensor] == ACCELERATION_STAGE) != of_forces:
            continue
        columns = slice(
            mj_model.sensor_adr[sensor], mj_model.sensor_adr[sensor] + mj_model.sensor_dim[sensor]
        )
        expected = mj_data.sensordata[columns]
        scale = max(1.0, float(np.abs(expected).max(initial=0.0)))
        what = mj_model.sensor(sensor).name or mujoco.mjtSensor(mj_model.sensor_type[sensor]).name
        found = world.sensordata_EL[1, columns].numpy()
        np.testing.assert_allclose(found, expected, atol=tolerance * scale, err_msg=what)


def step_and_check(
    xml: str | mujoco.MjModel,
    sim: SimCfg,
    *,
    substeps: int = 3,
    fields: Mapping[str, np.ndarray] | None = None,
    names: Sequence[str] = STATE,
    refreshes: bool = True,
    spread: float = 0.3,
    speed: float = 1.0,
) -> None:
    """Compare state, forces and sensors after some substeps, and then the sensors of the state that was reached."""
    world, mj_data, in_c = started(xml, sim, fields=fields, spread=spread, speed=speed)
    world.step(substeps)
    for _ in range(substeps):
        mujoco.mj_step(in_c, mj_data)
    check(world, mj_data, names)
    check_sensors(world, mj_data, of_forces=True)
    if refreshes:
        world.refresh()
        mujoco.mj_forward(in_c, mj_data)
        check_sensors(world, mj_data, of_forces=False)
