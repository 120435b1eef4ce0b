"""Worlds on MuJoCo's C engine, beside `mujoco.mj_step` on float32 states, and beside worlds on MuJoCo Warp."""

import copy
import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.agreement_models import QUADRUPED
from ksim_rl.physics import NanGuardCfg, SimCfg, World, load_model, views
from ksim_rl.physics.c_engine.c_world import CWorld
from ksim_rl.physics.ray_casting import BatchCamera, Picture, RayBatch
from tests.physics.models import SUBSTEPS, quadruped

IN_C = SimCfg(engine="c")
NUM_ENVS = 4
# What a step reads of a world: all of it is float32 between two steps.
STATE = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "time")
TABLE = """
<mujoco>
  <worldbody>
    <body name="table" pos="0 0 0.4"><geom name="top" type="box" size="0.5 0.5 0.05"/></body>
    <body pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom name="ball" size="0.1" mass="1"/></body>
    <camera name="eye" pos="0 -2 1"/>
  </worldbody>
</mujoco>
"""


def without_sensors() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(QUADRUPED)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    return spec.compile()


def thrown(num_envs: int = NUM_ENVS, mj_model: mujoco.MjModel | None = None, **kwargs) -> World:
    world = World(mj_model or quadruped(), num_envs=num_envs, sim=kwargs.pop("sim", IN_C), **kwargs)
    generator = torch.Generator().manual_seed(3)
    world.qvel_EL.copy_(0.5 * torch.randn(world.qvel_EL.shape, generator=generator))
    world.ctrl_EL.copy_(0.2 * torch.randn(world.ctrl_EL.shape, generator=generator))
    return world


def put(world: World, mj_data: mujoco.MjData, row: int) -> None:
    """Give C's data the float32 state of one world."""
    for name in STATE:
        value = world.view(name)[row].double().numpy()
        if name == "time":
            mj_data.time = float(value)
        else:
            getattr(mj_data, name)[:] = value


def test_the_engine_is_chosen_by_the_settings():
    assert isinstance(World(quadruped(), num_envs=1, sim=IN_C), CWorld)
    assert not isinstance(World(quadruped(), num_envs=1, sim=SimCfg(engine="warp")), CWorld)
    assert isinstance(thrown(), World)


def test_each_step_is_that_of_mj_step_bit_for_bit():
    world = thrown()
    mj_data = mujoco.MjData(world.mj_model)
    for _ in range(20):
        put(world, mj_data, 2)
        for _ in range(SUBSTEPS):
            mujoco.mj_step(world.mj_model, mj_data)
        world.step(SUBSTEPS)
        for name in ("qpos", "qvel", "qacc", "actuator_force", "sensordata"):
            expected = getattr(mj_data, name).astype(np.float32)
            np.testing.assert_array_equal(world.view(name)[2].numpy(), expected, err_msg=name)
        world.refresh()
        put(world, mj_data, 2)
        mujoco.mj_forward(world.mj_model, mj_data)
        for name in ("xpos", "xmat", "geom_xpos", "cvel", "subtree_com"):
            found = world.view(name)[2].numpy()
            np.testing.assert_array_equal(
                found, getattr(mj_data, name).astype(np.float32).reshape(found.shape)
            )


@pytest.mark.parametrize("integrator", ["implicitfast", "rk4"])
def test_forces_of_bodies_and_momenta_need_no_sensor(integrator):
    sim = dataclasses.replace(IN_C, integrator=integrator)
    world = thrown(mj_model=without_sensors(), sim=sim, per_world_fields=("body_mass",))
    read = sorted(views.FORCES_OF_BODIES | views.SUBTREE_VELOCITIES)
    for name in read:
        world.view(name)
    world.field("body_mass")[2] *= 2.0
    # Beside it, a world in which they are not read.
    plain = thrown(mj_model=without_sensors(), sim=sim, per_world_fields=("body_mass",))
    plain.field("body_mass")[2] *= 2.0
    heavier = copy.copy(world.mj_model)
    heavier.body_mass[:] = world.field("body_mass")[2].double().numpy()
    mj_data = mujoco.MjData(heavier)
    for _ in range(30):
        world.step(SUBSTEPS)
        plain.step(SUBSTEPS)
    put(world, mj_data, 2)
    for _ in range(SUBSTEPS - 1):
        mujoco.mj_step(heavier, mj_data)
    mujoco.mj_forward(heavier, mj_data)
    mujoco.mj_rnePostConstraint(heavier, mj_data)
    forces = {name: getattr(mj_data, name).astype(np.float32) for name in views.FORCES_OF_BODIES}
    assert np.abs(forces["cfrc_ext"]).max() > 1.0
    world.step(SUBSTEPS)
    plain.step(SUBSTEPS)
    world.refresh()
    for name, expected in forces.items():
        np.testing.assert_array_equal(world.view(name)[2].numpy(), expected, err_msg=name)
    assert torch.equal(world.qpos_EL, plain.qpos_EL)
    put(world, mj_data, 2)
    mujoco.mj_forward(heavier, mj_data)
    mujoco.mj_subtreeVel(heavier, mj_data)
    for name in views.SUBTREE_VELOCITIES:
        expected = getattr(mj_data, name).astype(np.float32)
        np.testing.assert_array_equal(world.view(name)[2].numpy(), expected, err_msg=name)
    mask_E = torch.tensor([False, False, True, False])
    world.reset(mask_E)
    world.refresh(mask_E)
    for name in read:
        assert not world.view(name)[2].any(), name
        assert world.view(name)[1].any(), name


def test_hooks_round_nothing_and_other_worlds_change_no_bit():
    at_once = thrown()
    hooked = thrown()
    for _ in range(5):
        at_once.step(SUBSTEPS)
        hooked.step(SUBSTEPS, before=[lambda: None], after=[lambda: None])
    assert torch.equal(at_once.qpos_EL, hooked.qpos_EL)
    assert torch.equal(thrown(1).qpos_EL[0], thrown().qpos_EL[0])


def test_a_hook_that_writes_controls_is_heeded_at_each_substep():
    world = thrown()
    mj_data = mujoco.MjData(world.mj_model)
    put(world, mj_data, 1)
    world.step(SUBSTEPS, before=[lambda: world.ctrl_EL.mul_(0.5)])
    for _ in range(SUBSTEPS):
        mj_data.ctrl[:] = (mj_data.ctrl * 0.5).astype(np.float32)
        mujoco.mj_step(world.mj_model, mj_data)
    np.testing.assert_array_equal(world.qpos_EL[1].numpy(), mj_data.qpos.astype(np.float32))


def test_a_checkpoint_continues_bit_for_bit():
    world = thrown()
    world.step(SUBSTEPS)
    saved = world.state_dict()
    world.step(SUBSTEPS)
    reached = world.qpos_EL.clone()
    other = World(quadruped(), num_envs=NUM_ENVS, sim=IN_C)
    other.load_state_dict(saved)
    other.step(SUBSTEPS)
    assert torch.equal(other.qpos_EL, reached)


def test_a_checkpoint_of_warp_is_refused():
    warp = World(quadruped(), num_envs=NUM_ENVS, sim=SimCfg(njmax=80, nconmax=40))
    with pytest.raises(ValueError, match="engine"):
        thrown().load_state_dict(warp.state_dict())


def test_nothing_of_a_poisoned_world_reaches_another():
    world, clean = thrown(), thrown()
    for one in (world, clean):
        for name in ("xpos", "sensordata", "qacc", "cvel", "subtree_com", "actuator_velocity"):
            one.view(name)
    world.qpos_EL[1] = torch.nan
    world.ctrl_EL[1] = torch.nan
    others = torch.tensor([0, 2, 3])
    for _ in range(3):
        world.step(SUBSTEPS)
        world.refresh()
        clean.step(SUBSTEPS)
        clean.refresh()
        mask_E = torch.tensor([True, False, False, True])
        for one in (world, clean):
            one.reset(mask_E)
            one.refresh(mask_E)
    for name, tensor in clean.views().items():
        assert torch.equal(world.view(name)[others], tensor[others]), name
    assert not world.qpos_EL[1].isfinite().any()


def test_a_masked_reset_equals_a_fresh_world_and_leaves_the_others():
    world = thrown()
    world.step(SUBSTEPS)
    world.refresh()
    before = {name: tensor.clone() for name, tensor in world.views().items()}
    mask_E = torch.tensor([False, True, False, False])
    world.reset(mask_E)
    world.refresh(mask_E)
    fresh = World(quadruped(), num_envs=NUM_ENVS, sim=IN_C)
    for name, tensor in world.views().items():
        assert torch.equal(tensor[~mask_E], before[name][~mask_E]), name
    for name in ("qpos", "qvel", "xpos", "qacc", "time"):
        assert torch.equal(world.view(name)[1], fresh.view(name)[1]), name


def test_fields_of_a_world_are_those_of_a_model_with_them():
    world = World(
        load_model(TABLE),
        num_envs=2,
        sim=IN_C,
        per_world_fields=("body_pos", "body_mass", "geom_size", "gravity"),
    )
    world.field("body_pos")[1, 1, 2] = 0.2
    world.field("geom_size")[1, 1, 0] = 0.15
    world.field("body_mass")[1, 2] = 3.0
    world.set_const(("body_pos", "body_mass", "geom_size"), torch.tensor([False, True]))
    for _ in range(300):
        world.step(4)
    world.refresh()
    heights = world.view("geom_xpos")[:, 1, 2]
    torch.testing.assert_close(heights, torch.tensor([0.55, 0.40]), atol=2e-3, rtol=0.0)
    assert world.field("geom_rbound")[1, 1] == pytest.approx(0.15)
    assert world.field("body_invweight0")[1, 2, 0] == pytest.approx(1.0 / 3.0, rel=1e-5)
    assert world.field("body_invweight0")[0, 2, 0] == pytest.approx(
        1.0 / world.mj_model.body_mass[2], rel=1e-5
    )


def test_rays_hit_what_they_hit_in_warp():
    start = torch.tensor([[0.0, 0.0, 3.0], [0.3, 0.0, 3.0], [5.0, 0.0, 3.0]])
    found = []
    for sim in (IN_C, SimCfg()):
        world = World(load_model(TABLE), num_envs=2, sim=sim)
        world.refresh()
        rays = RayBatch(world, 3, geom_groups=(0,))
        rays.start_EN3.copy_(start)
        rays.direction_EN3.copy_(torch.tensor([0.0, 0.0, -1.0]))
        rays.cast()
        found.append((rays.distance_EN.clone(), rays.normal_EN3.clone()))
    torch.testing.assert_close(found[0], found[1], atol=1e-5, rtol=0.0)


def test_a_world_that_fails_is_kept_for_replay(tmp_path):
    sim = dataclasses.replace(IN_C, nan_guard=NanGuardCfg(folder=str(tmp_path)))
    world = thrown(sim=sim)
    world.step(SUBSTEPS)
    world.qvel_EL[2, 0] = torch.inf
    world.step(SUBSTEPS)
    assert int(world.nan_count()) == 1
    report = world.nan_report()
    assert report.worlds == (2,)
    assert len(report.files) == 1


def test_settings_of_our_kernels_are_refused_and_those_of_room_mean_nothing():
    with pytest.raises(ValueError, match="one_kernel_dynamics=True"):
        World(quadruped(), num_envs=1, sim=SimCfg(engine="c", one_kernel_dynamics=True))
    narrow = thrown(sim=SimCfg(engine="c", njmax=4, nconmax=2))
    roomy = thrown()
    for world in (narrow, roomy):
        for _ in range(10):
            world.step(SUBSTEPS)
    assert torch.equal(narrow.qpos_EL, roomy.qpos_EL)


def test_what_the_engine_has_not_is_refused_by_name():
    world = World(load_model(TABLE), num_envs=1, sim=IN_C)
    with pytest.raises(ValueError, match=r"camera 'eye' .* choose sim.engine='warp'"):
        BatchCamera(world, "eye", Picture(width=8, height=8))
    with pytest.raises(ValueError, match="no Warp arrays"):
        world.launch("mine", lambda: None)


def test_it_runs_what_warp_refuses():
    pgs = QUADRUPED.replace("<option", '<option solver="PGS" noslip_iterations="3"', 1)
    mj_model = mujoco.MjModel.from_xml_string(pgs)
    assert mj_model.opt.solver == mujoco.mjtSolver.mjSOL_PGS
    world = World(mj_model, num_envs=2, sim=IN_C)
    mj_data = mujoco.MjData(world.mj_model)
    put(world, mj_data, 1)
    world.step(3)
    for _ in range(3):
        mujoco.mj_step(world.mj_model, mj_data)
    np.testing.assert_array_equal(world.qpos_EL[1].numpy(), mj_data.qpos.astype(np.float32))
