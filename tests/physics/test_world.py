import threading

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model, views
from tests.physics.models import (
    NUM_ENVS,
    cartpole,
    forwarded,
    quadruped,
    sensor,
    standing_quadrupeds,
)

ACCELERATION_SENSORS = ("acceleration", "knee_force", "touch", "front_left_contact")
OTHER_SENSORS = ("gyro", "velocity", "up", "momentum", "knee_pos", "servo_pos", "servo_vel")


def test_step_is_bit_identical_to_mujoco_warp():
    world = standing_quadrupeds(sim=SimCfg(njmax=80, nconmax=40, one_kernel_solver=False))
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(world.mj_model)
        m.opt.warn_overflow = 0
        d = mjw.make_data(world.mj_model, nworld=NUM_ENVS, nconmax=world.nconmax, njmax=world.njmax)
        for name in ("qpos", "qvel", "ctrl", "qacc_warmstart", "time"):
            wp.to_torch(getattr(d, name)).copy_(world.view(name))
        for _ in range(3):
            world.step(4, sensors="every")
            for _ in range(4):
                mjw.step(m, d)
    for name in ("qpos", "qvel", "qacc", "time", "sensordata", "actuator_force"):
        assert torch.equal(world.view(name), wp.to_torch(getattr(d, name))), name


def test_refresh_makes_positions_and_velocities_those_of_the_present_state():
    world = standing_quadrupeds()
    world.step(4)
    before = world.sensordata_EL.clone()
    world.refresh()
    for row in range(NUM_ENVS):
        expected = forwarded(world, row)
        for name in OTHER_SENSORS:
            columns = sensor(world, name)
            np.testing.assert_allclose(
                world.sensordata_EL[row, columns],
                expected.sensordata[columns],
                atol=2e-5,
                err_msg=name,
            )
        np.testing.assert_allclose(world.xpos_EL[row], expected.xpos, atol=1e-6)
        np.testing.assert_allclose(world.cvel_EL[row], expected.cvel, atol=1e-5)
    gyro = sensor(world, "gyro")
    assert not torch.equal(before[:, gyro], world.sensordata_EL[:, gyro])


def test_refresh_leaves_acceleration_stage_sensors_alone():
    world = standing_quadrupeds()
    world.step(4)
    before = world.sensordata_EL.clone()
    world.refresh()
    for name in ACCELERATION_SENSORS:
        columns = sensor(world, name)
        assert torch.equal(before[:, columns], world.sensordata_EL[:, columns]), name
    assert (world.sensordata_EL[:, sensor(world, "front_left_contact")][:, 0] == 1).any()


def test_reset_touches_only_the_masked_rows_even_row_zero():
    world = standing_quadrupeds()
    names = (
        "qpos",
        "qvel",
        "qacc",
        "sensordata",
        "actuator_force",
        "qfrc_actuator",
        "xpos",
        "qacc_warmstart",
    )
    before = {name: world.view(name).clone() for name in names}
    mask_E = torch.tensor([True, False, True, False])
    world.reset(mask_E)
    world.refresh()
    for name in names:
        assert torch.equal(world.view(name)[~mask_E], before[name][~mask_E]), name
    qpos0 = torch.from_numpy(world.mj_model.qpos0).float()
    assert torch.equal(world.qpos_EL[mask_E], qpos0.expand(2, -1))
    assert world.qvel_EL[mask_E].abs().max() == 0
    assert world.time_E.tolist()[::2] == [0.0, 0.0]
    for name in ACCELERATION_SENSORS:
        assert world.sensordata_EL[mask_E][:, sensor(world, name)].abs().max() == 0, name
    for name in ("qacc", "actuator_force", "qfrc_actuator"):
        assert world.view(name)[mask_E].abs().max() == 0, name
    # The pose after a refresh is qpos0: the torso stands upright.
    up = sensor(world, "up")
    torch.testing.assert_close(
        world.sensordata_EL[mask_E][:, up], torch.tensor([[0.0, 0.0, 1.0]] * 2)
    )


def test_rows_that_did_not_reset_go_on_as_if_nothing_happened():
    one, other = standing_quadrupeds(), standing_quadrupeds()
    one.reset(torch.tensor([True, False, False, True]))
    one.step(4)
    other.step(4)
    assert torch.equal(one.qpos_EL[1:3], other.qpos_EL[1:3])
    assert torch.equal(one.sensordata_EL[1:3], other.sensordata_EL[1:3])


def test_non_finite_world_stays_alone_and_a_reset_heals_it():
    sick, healthy = standing_quadrupeds(), standing_quadrupeds()
    sick.qvel_EL[1] = torch.nan
    for world in (sick, healthy):
        world.step(4)
    others = [0, 2, 3]
    assert torch.equal(sick.qpos_EL[others], healthy.qpos_EL[others])
    assert not torch.isfinite(sick.qpos_EL[1]).all()
    sick.reset(torch.arange(NUM_ENVS) == 1)
    sick.step(4)
    assert torch.isfinite(sick.qpos_EL).all()
    assert torch.isfinite(sick.sensordata_EL).all()


def test_a_reset_and_a_refresh_heal_bodies_that_are_welded():
    weld = "<weld body1='hand' body2='held'/>"
    model = load_model(
        "<mujoco><worldbody><body name='hand' mocap='true' pos='0 0 1'/><body name='held' pos='0 0 1'><freejoint/>"
        f"<geom size='0.1'/></body></worldbody><equality>{weld}</equality></mujoco>"
    )
    world, fresh = (World(model, num_envs=2) for _ in range(2))
    world.qvel_EL[1] = torch.nan
    world.step(2)
    assert torch.isfinite(world.qpos_EL).all(-1).tolist() == [True, False]
    world.reset(torch.tensor([False, True]))
    world.refresh()
    world.step(1)
    fresh.step(1)
    assert torch.equal(world.qvel_EL[1], fresh.qvel_EL[1])


def test_views_share_memory_with_warp_and_have_mujocos_shapes():
    world = standing_quadrupeds()
    nbody = world.mj_model.nbody
    assert world.xpos_EL.shape == (NUM_ENVS, nbody, 3)
    assert world.xquat_EL.shape == (NUM_ENVS, nbody, 4)
    assert world.xmat_EL.shape == (NUM_ENVS, nbody, 3, 3)
    assert world.cvel_EL.shape == (NUM_ENVS, nbody, 6)
    assert world.xfrc_applied_EL.shape == (NUM_ENVS, nbody, 6)
    assert world.act_EL.shape == (NUM_ENVS, 0)
    address = world.qpos_EL.data_ptr()
    world.qpos_EL[2, 0] = 7.0
    assert world.warp_data_E.qpos.numpy()[2, 0] == 7.0
    world.step(1)
    assert world.qpos_EL.data_ptr() == address == world.warp_data_E.qpos.ptr
    assert world.last_substep("efc.force").shape == (NUM_ENVS, world.njmax)
    with pytest.raises(ValueError, match="did you mean 'qfrc_constraint'"):
        world.view("qfrc_constrain")


def test_applied_forces_and_gravity_act_per_world():
    world = World(cartpole(), num_envs=3)
    world.gravity_EL[1] = 0.0
    world.qpos_EL[:, 1] = 0.3
    world.qfrc_applied_EL[2, 0] = 5.0
    world.step(10)
    pole_acc = world.qvel_EL[:, 1].tolist()
    assert pole_acc[0] > 0.1
    assert abs(pole_acc[1]) < 1e-6
    assert world.qpos_EL[2, 0] > 0.01


def test_two_threads_may_step_two_worlds():
    worlds = [World(cartpole(), num_envs=2) for _ in range(2)]
    for world in worlds:
        world.qpos_EL[:, 1] = 0.5
        world.step(2)

    def run(world: World) -> None:
        for _ in range(200):
            world.step(2)

    threads = [threading.Thread(target=run, args=(world,)) for world in worlds]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert torch.equal(worlds[0].qpos_EL, worlds[1].qpos_EL)


def test_the_model_of_the_caller_is_not_changed():
    before = quadruped().opt.timestep
    world = World(
        quadruped(), num_envs=1, sim=SimCfg(timestep=0.002, cone="elliptic", njmax=80, nconmax=40)
    )
    assert world.timestep == 0.002
    assert quadruped().opt.timestep == before
    world.step(5)
    assert world.time_E.item() == pytest.approx(0.01)


@pytest.mark.parametrize("num_envs", [0, -1, 2.0, True])
def test_num_envs_is_checked(num_envs):
    with pytest.raises(ValueError, match="num_envs"):
        World(cartpole(), num_envs=num_envs)


def test_arguments_are_checked():
    with pytest.raises(ValueError, match="mj_model='robot.xml': expected a mujoco.MjModel"):
        World("robot.xml", num_envs=2)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="sim={'njmax': 8}: expected a SimCfg"):
        World(cartpole(), num_envs=2, sim={"njmax": 8})  # pyright: ignore[reportArgumentType]
    world = World(cartpole(), num_envs=2)
    with pytest.raises(ValueError, match="n=0"):
        world.step(0)
    with pytest.raises(ValueError, match="expected torch.bool of shape"):
        world._take_mask(torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"expected torch.bool of shape \(2,\)"):
        world._take_mask(torch.ones(2))
    with pytest.raises(ValueError, match="device='meta'"):
        World(cartpole(), num_envs=2, device="meta")
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="no CUDA device"):
            World(cartpole(), num_envs=2, device="cuda")


def test_memory_is_counted_and_given_back():
    small, large = (World(cartpole(), num_envs=n) for n in (8, 64))
    assert 500 < large.bytes_per_world() <= small.bytes_per_world() < 50_000
    large.close()
    assert not hasattr(large, "warp_data_E")


def test_what_is_read_directly_is_current_or_refused():
    world = standing_quadrupeds()
    bias_EL, mass = world.view("qfrc_bias"), world.view("M")
    world.step(3)
    world.qvel_EL.uniform_(-2.0, 2.0)
    world.refresh()
    mj_data = mujoco.MjData(world.mj_model)
    for row in range(NUM_ENVS):
        mj_data.qpos[:], mj_data.qvel[:] = world.qpos_EL[row], world.qvel_EL[row]
        mujoco.mj_forward(world.mj_model, mj_data)
        np.testing.assert_allclose(bias_EL[row], mj_data.qfrc_bias, atol=2e-4)
        np.testing.assert_allclose(np.sort(mass[row].ravel()), np.sort(mj_data.M), atol=1e-5)
    for name in ("efc.force", "contact.dist", "nefc", "qfrc_smooth", "qLD", "actuator_moment"):
        with pytest.raises(ValueError, match=f"{name}.*last_substep"):
            world.view(name)
        assert world.last_substep(name).shape[0] > 0
    world.is_frozen = True
    assert world.view("M") is mass
    with pytest.raises(RuntimeError, match="ten_velocity is not computed"):
        world.view("ten_velocity")


def test_every_array_that_may_be_read_is_current_after_a_refresh():
    """Two refreshes after a step: what the second changes, or a fresh forward pass finds otherwise, is not current."""
    world = standing_quadrupeds()
    for name in sorted(views.ON_DEMAND):
        world.view(name)
    world.step(5)
    world.refresh()
    names = {*views.READABLE} - {*views.STATE} - {"wrap_obj", "ten_wrapadr", "ten_wrapnum"}
    found = {name: world.view(name).clone() for name in names if world.view(name).numel()}
    with wp.ScopedDevice("cpu"):
        mjw.forward(world.warp_model, world.warp_data_E)
    assert len(found) >= 20
    for name, tensor in found.items():
        torch.testing.assert_close(tensor, world.view(name), atol=1e-5, rtol=1e-4, msg=name)
