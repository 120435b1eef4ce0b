"""The one kernel of the smooth dynamics on a GPU, where lanes of a warp share a world."""

import mujoco_warp as mjw
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World
from ksim_rl.physics.smooth import stages
from tests.physics.test_smooth import GEOMS, PER_WORLD, WRITTEN, mixed

# Not a multiple of the worlds of a warp.
NUM_ENVS = 301
LANES = (4, 8, 16, 32)


def worlds() -> World:
    sim = SimCfg(njmax=16, nconmax=16, one_kernel_dynamics=True)
    world = World(mixed(), num_envs=NUM_ENVS, sim=sim, device="cuda", per_world_fields=PER_WORLD)
    generator = torch.Generator(device="cuda").manual_seed(0)
    for name in ("qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos"):
        row = world.view(name)
        row.add_(0.5 * torch.randn(row.shape, generator=generator, device="cuda"))
    world.xfrc_applied_EL[::2] = 0.0
    mass = world.field("body_mass")
    mass.mul_(1.0 + torch.rand(mass.shape, generator=generator, device="cuda"))
    world.set_const(("body_mass",))
    return world


def results(world: World, lanes: int) -> dict[str, torch.Tensor]:
    for name in WRITTEN:
        world.last_substep(name).fill_(7.0)
    with wp.ScopedDevice("cuda"):
        stages.smooth_dynamics(world.warp_model, world.warp_data_E, lanes=lanes)()
        wp.synchronize()
    return {name: world.last_substep(name).clone() for name in (*WRITTEN, *GEOMS)}


@pytest.mark.gpu
def test_all_numbers_of_lanes_give_the_same_bits_which_are_those_of_mujoco_warp():
    world = worlds()
    found = [results(world, lanes) for lanes in LANES]
    with wp.ScopedDevice("cuda"):
        mjw.fwd_position(world.warp_model, world.warp_data_E, factorize=False)
        mjw.fwd_velocity(world.warp_model, world.warp_data_E)
        mjw.fwd_actuation(world.warp_model, world.warp_data_E)
        mjw.fwd_acceleration(world.warp_model, world.warp_data_E, factorize=True)
        wp.synchronize()
    for name, ours in found[0].items():
        for other in found[1:]:
            assert torch.equal(other[name], ours), name
        theirs = world.last_substep(name)
        scale = 1.0 + theirs.abs().max()
        torch.testing.assert_close(ours / scale, theirs / scale, atol=3e-6, rtol=0, msg=name)


@pytest.mark.gpu
def test_what_is_not_finite_stays_in_its_world_bit_for_bit():
    world = worlds()
    clean = results(world, 8)
    world.qvel_EL[1] = torch.nan
    spoilt = results(world, 8)
    others = torch.arange(NUM_ENVS, device="cuda") != 1
    assert spoilt["qfrc_smooth"][1].isnan().all()
    for name, ours in clean.items():
        assert torch.equal(spoilt[name][others], ours[others]), name


@pytest.mark.gpu
@pytest.mark.parametrize("lanes", LANES)
def test_a_mask_spares_worlds_and_momenta_are_those_of_mujoco_warp(lanes):
    world, names = worlds(), ("xpos", "cvel", "subtree_linvel", "subtree_angmom")
    mask_E = torch.rand(NUM_ENVS, device="cuda") > 0.7
    arrays = {name: wp.to_torch(getattr(world.warp_data_E, name)) for name in names}
    with wp.ScopedDevice("cuda"):
        mask = wp.from_torch(mask_E)
        launch = stages.smooth_dynamics(world.warp_model, world.warp_data_E, lanes=lanes, mask=mask)
        launch(forces_too=False, sums_momenta=True)
        whole = {name: array.clone() for name, array in arrays.items()}
        for array in arrays.values():
            array.fill_(7.0)
        launch(forces_too=False, sums_momenta=True, masked=True)
        wp.synchronize()
        for name, array in arrays.items():
            assert torch.equal(array[mask_E], whole[name][mask_E]), name
            assert (array[~mask_E] == 7.0).all(), name
        launch(forces_too=False)
        mjw.subtree_vel(world.warp_model, world.warp_data_E)
        wp.synchronize()
    for name in ("subtree_linvel", "subtree_angmom"):
        scale = 1.0 + arrays[name].abs().max()
        torch.testing.assert_close(
            whole[name] / scale, arrays[name] / scale, atol=3e-6, rtol=0, msg=name
        )


@pytest.mark.gpu
def test_captured_steps_reach_what_mujoco_warps_kernels_reach():
    reached = []
    for one_kernel_dynamics in (None, False):
        sim = SimCfg(njmax=16, nconmax=16, one_kernel_dynamics=one_kernel_dynamics)
        world = World(mixed(), num_envs=NUM_ENVS, sim=sim, device="cuda")
        assert (world.one_kernel_dynamics_unavailable is None) == (one_kernel_dynamics is None)
        generator = torch.Generator(device="cuda").manual_seed(0)
        world.qvel_EL.copy_(
            0.1 * torch.randn(world.qvel_EL.shape, generator=generator, device="cuda")
        )
        for _ in range(4):
            world.step(4)
        reached.append((world.qpos_EL.clone(), world.qvel_EL.clone()))
    for ours, theirs in zip(*reached, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
