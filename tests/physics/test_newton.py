"""The one-kernel solver against MuJoCo's C engine and MuJoCo Warp's own solver, on rows of every kind."""

import dataclasses
from functools import partial

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.physics.newton import solver as newton
from ksim_rl.physics.newton.limbs import limbs_of
from tests.physics.rows_of_all_kinds import CONES, NUM_ENVS, ONE_OF_CONES, ROWS_OF_ALL_KINDS, worlds
from tests.physics.solver_problem import problems


def rows_of(world: World) -> None:
    with wp.ScopedDevice("cpu"):
        m, d = world.warp_model, world.warp_data_E
        mjw.fwd_position(m, d, factorize=False)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)
        mjw.fwd_acceleration(m, d, factorize=True)


@pytest.mark.parametrize("cone", CONES)
def test_accelerations_and_forces_are_those_of_the_c_engine(cone):
    world = worlds(cone)
    assert world.has_one_kernel_solver
    rows_of(world)
    with wp.ScopedDevice("cpu"):
        newton.solver(world.warp_model, world.warp_data_E)()
    seen = set()
    for row in range(NUM_ENVS):
        mj_data = mujoco.MjData(world.mj_model)
        mj_data.qpos[:], mj_data.qvel[:] = world.qpos_EL[row], world.qvel_EL[row]
        mujoco.mj_forward(world.mj_model, mj_data)
        assert mj_data.nefc == world.last_substep("nefc")[row]
        seen |= set(mj_data.efc_type.tolist())
        scale = 1.0 + np.abs(mj_data.qacc).max()
        np.testing.assert_allclose(world.qacc_EL[row] / scale, mj_data.qacc / scale, atol=2e-4)
        forces = world.view("qfrc_constraint")[row].numpy()
        scale = 1.0 + np.abs(mj_data.qfrc_constraint).max()
        np.testing.assert_allclose(forces / scale, mj_data.qfrc_constraint / scale, atol=2e-4)
    kinds = mujoco.mjtConstraint
    contact = (
        kinds.mjCNSTR_CONTACT_ELLIPTIC if cone == "elliptic" else kinds.mjCNSTR_CONTACT_PYRAMIDAL
    )
    expected = (
        kinds.mjCNSTR_EQUALITY,
        kinds.mjCNSTR_FRICTION_DOF,
        kinds.mjCNSTR_FRICTION_TENDON,
        kinds.mjCNSTR_LIMIT_JOINT,
        kinds.mjCNSTR_LIMIT_TENDON,
        kinds.mjCNSTR_CONTACT_FRICTIONLESS,
        contact,
    )
    assert seen == {int(kind) for kind in expected}


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("iterations", [100, 2])
def test_iterations_and_overflow_are_those_of_mujoco_warp(cone, iterations):
    world = worlds(cone, iterations=iterations)
    rows_of(world)
    todo, found = problems(world), []
    with wp.ScopedDevice("cpu"):
        model, data = world.warp_model, world.warp_data_E
        for solve in (partial(mjw.solve, model, data), newton.solver(model, data)):
            world.view("overflow").zero_()
            solve()
            names = ("qacc", "qfrc_constraint", "efc.Ma", "efc.state", "solver_niter", "overflow")
            found.append({name: world.last_substep(name).clone() for name in names})
    theirs, ours = found
    # In its last steps an iteration is decided by rounding; fewer may do.
    assert (ours["solver_niter"] - theirs["solver_niter"]).max() <= (2 if iterations == 100 else 0)
    if iterations == 2:
        # Its line searches are shorter, so that it is elsewhere halfway; a world may have arrived all the same.
        assert not (ours["overflow"] & ~theirs["overflow"]).any() and ours["overflow"].any()
        start, there, here = (
            np.array(
                [
                    problem.cost(each)
                    for problem, each in zip(todo, qacc.double().numpy(), strict=True)
                ]
            )
            for qacc in (torch.zeros_like(ours["qacc"]), theirs["qacc"], ours["qacc"])
        )
        # Of what MuJoCo Warp has saved by then, 0.5 % was the most that ours had not.
        assert (start > there).all() and (here - there <= 0.01 * (start - there)).all()
        return
    for name in ("qacc", "qfrc_constraint", "efc.Ma"):
        scale = 1.0 + theirs[name].abs().amax(-1, keepdim=True)
        torch.testing.assert_close(
            ours[name] / scale, theirs[name] / scale, atol=2e-4, rtol=0, msg=name
        )
    for row, count in enumerate(world.last_substep("nefc").tolist()):
        assert torch.equal(ours["efc.state"][row, :count], theirs["efc.state"][row, :count])


@pytest.mark.parametrize("cone", ONE_OF_CONES)
def test_rows_that_find_no_room_in_shared_memory_solve_alike(cone):
    world = worlds(cone)
    rows_of(world)
    found = []
    with wp.ScopedDevice("cpu"):
        for rows_in_shared in (world.njmax, 10, 0):
            world.qacc_EL.zero_()
            newton.solver(world.warp_model, world.warp_data_E, rows_in_shared=rows_in_shared)()
            found.append(world.qacc_EL.clone())
    assert found[0].any()
    for other in found[1:]:
        torch.testing.assert_close(other, found[0], rtol=1e-5, atol=1e-5)


LIMBS = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" iterations="100" tolerance="1e-8" cone="{cone}" impratio="3"/>
  <worldbody>
    <geom type="plane" size="5 5 1" condim="{condim}" friction="0.8 0.02 0.01"/>
    <body name="trunk" pos="0 0 0.42">
      <freejoint/>
      <geom type="box" size="0.2 0.2 0.05" mass="2" contype="0"/>
      {legs}
    </body>
    <body pos="2 0 0.3"><freejoint/><geom size="0.1" contype="0" conaffinity="0"/></body>
  </worldbody>
</mujoco>
"""
LEG = """
<body pos="{x} {y} 0">
  <joint axis="0 1 0" range="-0.3 0.3" limited="true" frictionloss="0.05" armature="0.01"/>
  <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2" mass="0.2" contype="0" conaffinity="0"/>
  <body pos="0 0 -0.2">
    <joint axis="1 0 0" armature="0.01"/>
    <geom size="0.04" pos="0 0 -0.1" mass="0.1" contype="2" conaffinity="1"/>
    {shank}
  </body>
</body>
"""
SHANK = """
<body pos="0 0 -0.1"><joint axis="0 0 1" armature="0.01"/>
<geom size="0.05" pos="0 0 -0.06" condim="{condim}" mass="0.1" contype="1" conaffinity="3"/></body>
"""


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("spacing", [0.15, 0.03])
def test_limbs_with_and_without_contacts_between_them_move_as_in_the_c_engine(cone, spacing):
    condim = 6 if cone == "elliptic" else 3
    shanks = (
        SHANK.format(condim=condim),
        SHANK.format(condim=condim),
        "",
        SHANK.format(condim=condim),
    )
    places = [(x, y) for x in (-spacing, spacing) for y in (-0.15, 0.15)]
    legs = "".join(
        LEG.format(x=x, y=y, shank=shank) for (x, y), shank in zip(places, shanks, strict=True)
    )
    model = load_model(LIMBS.format(cone=cone, condim=condim, legs=legs))
    limbs = limbs_of(model.dof_parentid.tolist())
    assert len(limbs.trunk) == 6 and [len(chain) for chain in limbs.chains] == [2, 3, 3, 3, 6]
    world = World(model, num_envs=NUM_ENVS, sim=SimCfg(njmax=160, nconmax=32, tolerance=1e-8))
    generator = torch.Generator().manual_seed(1)
    world.qpos_EL[:, 2] -= 0.02 * torch.rand(NUM_ENVS, generator=generator)
    world.qvel_EL.copy_(0.7 * torch.randn(world.qvel_EL.shape, generator=generator))
    rows_of(world)
    touched = []
    for rows_in_shared in (world.njmax, 3):
        world.qacc_EL.zero_()
        with wp.ScopedDevice("cpu"):
            newton.solver(world.warp_model, world.warp_data_E, rows_in_shared=rows_in_shared)()
        for row in range(NUM_ENVS):
            mj_data = mujoco.MjData(model)
            mj_data.qpos[:], mj_data.qvel[:] = world.qpos_EL[row], world.qvel_EL[row]
            mujoco.mj_forward(model, mj_data)
            assert mj_data.nefc == world.last_substep("nefc")[row] > 0
            touched += [0 not in model.geom_bodyid[pair] for pair in mj_data.contact.geom]
            for name, ours in (
                ("qacc", world.qacc_EL),
                ("qfrc_constraint", world.view("qfrc_constraint")),
            ):
                theirs = getattr(mj_data, name)
                scale = 1.0 + np.abs(theirs).max()
                np.testing.assert_allclose(
                    ours[row] / scale, theirs / scale, atol=3e-4, err_msg=name
                )
    # Only limbs that are close together touch each other, and fill the Hessian.
    assert any(touched) == (spacing < 0.1)


@pytest.mark.parametrize("num_worlds", [4096, 32768])
@pytest.mark.parametrize("floats", [300, 1760, 2400, 3000, 4400, 4576, 5536, 12_000])
def test_registers_are_bounded_so_that_as_many_worlds_run_at_once_as_shared_memory_lets(
    floats, num_worlds
):
    by_memory = (228 * 1024) // (4 * floats + 1024)
    registers = newton.most_registers(floats, num_worlds)
    if registers is None:
        assert by_memory <= 16
        return
    warps_of_a_quarter = 65_536 // 4 // (32 * registers)
    least = newton.LEAST_REGISTERS[num_worlds > 8192]
    assert registers % 8 == 0 and least <= registers <= 128
    assert 4 * warps_of_a_quarter >= by_memory or registers == least


def test_steps_follow_those_of_mujoco_warp():
    ours, theirs = worlds("elliptic"), worlds("elliptic", one_kernel_solver=False)
    assert not theirs.has_one_kernel_solver
    for world in (ours, theirs):
        world.step(4)
    torch.testing.assert_close(ours.qpos_EL, theirs.qpos_EL, atol=2e-5, rtol=0)
    torch.testing.assert_close(ours.qvel_EL, theirs.qvel_EL, atol=2e-3, rtol=0)


def test_what_overflows_in_one_tree_leaves_the_others_alone():
    world = worlds("pyramidal")
    model = load_model(
        "<mujoco><worldbody><body><joint type='slide'/><geom size='0.1'/></body>"
        "<body pos='1 0 0'><joint type='slide'/><geom size='0.1' mass='1e-6'/></body></worldbody></mujoco>"
    )
    world = World(model, num_envs=1, sim=SimCfg(njmax=8, nconmax=8))
    world.view("qfrc_applied")[0, 1] = 1e35
    world.step(1)
    assert torch.isfinite(world.qvel_EL[0, 0]) and not torch.isfinite(world.qvel_EL[0, 1])


def test_models_out_of_range_take_the_solver_of_mujoco_warp():
    model = load_model(ROWS_OF_ALL_KINDS.format(cone="pyramidal", iterations=10))
    assert newton.unsuited(model, njmax=64) is None
    assert "100000 constraint rows" in str(newton.unsuited(model, njmax=100_000))
    assert "no constraint rows" in str(newton.unsuited(model, njmax=0))
    for field, value, reason in (
        ("solver", mujoco.mjtSolver.mjSOL_CG, "not Newton's"),
        ("integrator", mujoco.mjtIntegrator.mjINT_RK4, "mjINT_RK4"),
        ("iterations", 0, "no iterations"),
        ("noslip_iterations", 2, "noslip"),
        ("jacobian", mujoco.mjtJacobian.mjJAC_DENSE, "dense"),
        ("disableflags", mujoco.mjtDisableBit.mjDSBL_WARMSTART, "warm start"),
        ("enableflags", mujoco.mjtEnableBit.mjENBL_SLEEP, "sleep"),
        ("enableflags", mujoco.mjtEnableBit.mjENBL_ENERGY, "energies"),
    ):
        kept = getattr(model.opt, field)
        setattr(model.opt, field, int(value))
        assert reason in str(newton.unsuited(model, njmax=64)), field
        setattr(model.opt, field, kept)
    for count in (0, 65):
        bodies = "<body><joint/><geom size='0.1'/></body>" * count
        many = load_model(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
        assert f"{count} degrees of freedom" in str(newton.unsuited(many, njmax=8))
    sim = SimCfg(njmax=64, nconmax=16)
    with pytest.raises(ValueError, match="one_kernel_solver='auto': expected true or false"):
        SimCfg(one_kernel_solver="auto")  # pyright: ignore[reportArgumentType]
    world = World(model, num_envs=1, sim=sim)
    assert world.has_one_kernel_solver and world.one_kernel_unavailable is None
    for setting in ({"one_kernel_solver": False}, {"integrator": "rk4"}):
        world = World(model, num_envs=1, sim=dataclasses.replace(sim, **setting))
        reason = str(world.one_kernel_unavailable)
        assert not world.has_one_kernel_solver and next(iter(setting)) in reason, reason


def test_a_step_calls_the_control_callback_as_mujoco_warp_does():
    reached = []
    for sim in (SimCfg(one_kernel_dynamics=True), SimCfg(one_kernel_solver=False)):
        model = load_model(
            "<mujoco><worldbody><body><joint name='j' type='slide'/><geom size='0.1' mass='1'/></body></worldbody>"
            "<actuator><motor joint='j'/></actuator></mujoco>"
        )
        world = World(model, num_envs=1, sim=sim)
        world.gravity_EL.zero_()
        world.warp_model.callback.control = lambda m, d: d.ctrl.fill_(2.0)
        world.step(1)
        reached.append(world.qvel_EL.item())
    assert reached[0] == pytest.approx(2.0 * model.opt.timestep) and reached[0] == pytest.approx(
        reached[1]
    )


@pytest.mark.parametrize("with_rows", [False, True])
@pytest.mark.parametrize("far", [0.0, 1e6])
def test_a_far_warm_start_leaves_no_trace(with_rows, far):
    world = worlds("elliptic")
    if not with_rows:
        model = load_model(
            "<mujoco><option timestep='0.004'/><worldbody><body pos='0 0 1'><freejoint/><geom size='0.1'/>"
            "<body><joint/><geom size='0.1' pos='0.2 0 0'/></body></body></worldbody></mujoco>"
        )
        world = World(model, num_envs=1, sim=SimCfg(njmax=8, nconmax=8))
        world.qvel_EL[:] = 1.0
    rows_of(world)
    world.view("qacc_warmstart").fill_(far)
    with wp.ScopedDevice("cpu"):
        newton.solver(world.warp_model, world.warp_data_E)()
    for row in range(world.num_envs):
        mj_data = mujoco.MjData(world.mj_model)
        mj_data.qpos[:], mj_data.qvel[:] = world.qpos_EL[row], world.qvel_EL[row]
        mujoco.mj_forward(world.mj_model, mj_data)
        assert (mj_data.nefc > 0) == with_rows
        scale = 1.0 + np.abs(mj_data.qacc).max()
        atol = 2e-4 if with_rows else 2e-6
        np.testing.assert_allclose(world.qacc_EL[row] / scale, mj_data.qacc / scale, atol=atol)


TWO_BALLS = """
<mujoco>
  <option cone="elliptic" iterations="100"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.099"><freejoint/><geom size="0.1" condim="{condim}"/></body>
    <body pos="1 0 0.099"><freejoint/><geom size="0.1" condim="{condim}"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("condim", "njmax"),
    [
        (3, 5),
        pytest.param(3, 4, marks=pytest.mark.full),
        pytest.param(4, 5, marks=pytest.mark.full),
    ],
)
def test_a_cone_that_njmax_cuts_off_pushes_nothing_as_with_mujoco_warp(condim, njmax):
    model = load_model(TWO_BALLS.format(condim=condim))
    world = World(model, num_envs=1, sim=SimCfg(njmax=njmax, nconmax=8, tolerance=1e-8))
    world.qvel_EL[0, [0, 6]] = 0.5
    rows_of(world)
    assert world.last_substep("nefc").item() == 2 * condim > njmax
    found = []
    with wp.ScopedDevice("cpu"):
        for solve in (partial(mjw.solve, world.warp_model, world.warp_data_E), None):
            world.last_substep("efc.force").zero_()
            world.last_substep("efc.state").zero_()
            (solve or newton.solver(world.warp_model, world.warp_data_E))()
            found.append(
                [world.last_substep(name)[0].clone() for name in ("qacc", "efc.force", "efc.state")]
            )
    theirs, ours = found
    assert ours[0][8] == pytest.approx(-9.81)
    for mine, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, expected, atol=1e-3, rtol=1e-4)


def test_forces_after_constraints_are_computed_where_the_option_asks_for_them():
    found = []
    for one_kernel_solver in (True, False):
        world = worlds("elliptic", one_kernel_solver=one_kernel_solver)
        world.warp_model.opt.run_rne_postconstraint = True
        world.step(2)
        found.append(world.view("cfrc_int").clone())
    assert found[0].abs().max() > 1.0
    torch.testing.assert_close(found[0], found[1], atol=1e-2, rtol=1e-3)
