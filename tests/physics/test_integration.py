"""The one kernel that integrates a substep, against the C engine and against MuJoCo Warp's own kernels."""

import copy

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.physics.smooth import stages
from tests.physics.test_nan_guard import HEAVY, SLEDS
from tests.physics.test_smooth import (
    NUM_ENVS,
    PER_WORLD,
    draw_parameters,
    mixed,
    moved,
    with_parameters_of,
)

STATE = ("qpos", "qvel", "act", "time")
WRITTEN = (*STATE, "qacc_warmstart")
EULER, FAST = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
Bit = mujoco.mjtDisableBit
# Without one of actuation and damping MuJoCo Warp forgets the derivative of the other, and without both and springs the
# derivative of gyroscopic forces.
AS_IN_MUJOCO_WARP = [
    (EULER, 0),
    (EULER, Bit.mjDSBL_EULERDAMP),
    (EULER, Bit.mjDSBL_DAMPER),
    (EULER, Bit.mjDSBL_ACTUATION),
    (FAST, 0),
    (FAST, Bit.mjDSBL_EULERDAMP),
    (FAST, Bit.mjDSBL_ACTUATION | Bit.mjDSBL_DAMPER),
]
AS_IN_C = [
    *AS_IN_MUJOCO_WARP,
    (FAST, Bit.mjDSBL_DAMPER),
    (FAST, Bit.mjDSBL_ACTUATION),
    (FAST, Bit.mjDSBL_ACTUATION | Bit.mjDSBL_DAMPER | Bit.mjDSBL_SPRING),
]


def spinning(**kwargs) -> World:
    """Worlds in other states each, with a free body that gyroscopic forces turn."""
    world = moved(**kwargs)
    world.qvel_EL[:, -3:] += torch.tensor([20.0, -30.0, 10.0])
    return world


def with_options(integrator: int, disabled: int) -> World:
    """Worlds in other states each, which MuJoCo Warp has brought to the end of the solver."""
    model = copy.copy(mixed())
    model.opt.integrator, model.opt.disableflags = integrator, disabled
    world = spinning(model=model, sim=SimCfg(one_kernel_dynamics=False))
    with wp.ScopedDevice("cpu"):
        mjw.forward(world.warp_model, world.warp_data_E)
    return world


def integrate(world: World) -> None:
    with wp.ScopedDevice("cpu"):
        stages.integration(world.warp_model, world.warp_data_E)()


def values(world: World, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
    return {name: world.last_substep(name).clone() for name in names}


def check_step(
    world: World, before: dict[str, torch.Tensor], mj_model: mujoco.MjModel, row: int
) -> None:
    mj_data = mujoco.MjData(mj_model)
    for name, rows in before.items():
        setattr(mj_data, name, rows[row].numpy())
    mujoco.mj_step(mj_model, mj_data)
    for name in STATE:
        ours, theirs = world.last_substep(name)[row].numpy(), np.asarray(getattr(mj_data, name))
        scale = 1.0 + np.abs(theirs).max(initial=0.0)
        np.testing.assert_allclose(ours / scale, theirs / scale, atol=1e-4, err_msg=name)


INPUTS = (*STATE, "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat")


@pytest.mark.parametrize(("integrator", "disabled"), AS_IN_C)
def test_the_state_it_reaches_is_that_of_the_c_engine(integrator, disabled):
    world = with_options(integrator, disabled)
    before = values(world, INPUTS)
    integrate(world)
    for row in range(NUM_ENVS):
        check_step(world, before, world.mj_model, row)


@pytest.mark.parametrize(("integrator", "disabled"), AS_IN_MUJOCO_WARP)
def test_all_it_writes_is_as_in_mujoco_warp(integrator, disabled):
    found = []
    for own in (True, False):
        world = with_options(integrator, disabled)
        data = world.warp_data_E
        data.nefc.fill_(data.njmax + 1)
        data.nacon.fill_(data.naconmax + 1)
        data.ncollision.fill_(data.naconmax + 1)
        before = values(world, ("qacc", "M"))
        with wp.ScopedDevice("cpu"):
            if own:
                integrate(world)
            else:
                (mjw.euler if integrator == EULER else mjw.implicit)(world.warp_model, data)
        for name, kept in before.items():
            assert torch.equal(world.last_substep(name), kept), name
        found.append(values(world, WRITTEN) | {"overflow": wp.to_torch(data.overflow).clone()})
    for name, ours in found[0].items():
        if name == "act" and disabled & Bit.mjDSBL_ACTUATION:
            continue  # MuJoCo Warp puts those into their range that were out of it
        theirs = found[1][name]
        scale = 1.0 + theirs.abs().max()
        torch.testing.assert_close(ours / scale, theirs / scale, atol=2e-6, rtol=0, msg=name)


def test_whole_steps_are_those_of_the_c_engine_with_parameters_of_each_world():
    world = spinning(per_world_fields=PER_WORLD)
    assert world.one_kernel_integration_unavailable is None
    draw_parameters(world)
    before = values(world, INPUTS)
    world.step(1)
    for row in range(NUM_ENVS):
        check_step(world, before, with_parameters_of(world, row), row)


def test_the_derivative_of_a_gain_has_the_control_within_its_range():
    model = load_model(
        "<mujoco><option integrator='implicitfast'/><worldbody><body><joint name='j' armature='0.01'/>"
        "<geom size='0.01' mass='0.001'/></body></worldbody><actuator><general joint='j' gaintype='affine' "
        "gainprm='0 0 -2' ctrllimited='true' ctrlrange='-1 1'/></actuator></mujoco>"
    )
    world = World(model, num_envs=1, sim=SimCfg(njmax=8, nconmax=8))
    world.qvel_EL[:], world.ctrl_EL[:] = 1.0, 5.0
    with wp.ScopedDevice("cpu"):
        mjw.forward(world.warp_model, world.warp_data_E)
    before = values(world, INPUTS)
    integrate(world)
    check_step(world, before, model, 0)


def test_mujoco_warps_implicit_finds_the_inertias_of_free_bodies():
    world = spinning(sim=SimCfg(one_kernel_dynamics=True, integrator="implicit"))
    assert world.one_kernel_dynamics_unavailable is None
    assert "mjINT_IMPLICIT" in str(world.one_kernel_integration_unavailable)
    before = values(world, INPUTS)
    world.step(1)
    for row in range(NUM_ENVS):
        check_step(world, before, world.mj_model, row)


def test_what_is_not_finite_stays_in_its_world():
    found = []
    for spoilt in (False, True):
        world = moved()
        if spoilt:
            world.qvel_EL[1] = torch.nan
        world.step(1)
        found.append(values(world, WRITTEN))
    assert found[1]["qvel"][1].isnan().all()
    for name, clean in found[0].items():
        assert torch.equal(clean[[0, 2]], found[1][name][[0, 2]]), name


def test_a_gear_whose_square_no_float_holds_is_no_derivative_where_velocity_adds_no_force():
    world = World(load_model(SLEDS), num_envs=2, sim=SimCfg(one_kernel_dynamics=True))
    world.ctrl_EL[:, HEAVY] = 1.0
    world.step()
    expected = torch.zeros(world.qvel_EL.shape)
    expected[:, HEAVY] = world.timestep / 2.0  # 1 N on 2 kg
    torch.testing.assert_close(world.qvel_EL, expected)


def test_worlds_whose_dynamics_have_no_kernel_of_their_own_are_told_why():
    world = World(mixed(), num_envs=1, sim=SimCfg(one_kernel_dynamics=False))
    assert "one_kernel_dynamics is False" in str(world.one_kernel_integration_unavailable)
