"""The one-kernel solver on a GPU, where a warp shares a world, against MuJoCo Warp's own solver."""

from functools import partial

import mujoco_warp as mjw
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.physics.newton import solver as newton
from tests.physics.test_newton import CONES, ROWS_OF_ALL_KINDS

NUM_ENVS = 300
ROWS_ON_CHIP = (64, 8, 0)


def worlds(cone: str) -> World:
    model = load_model(ROWS_OF_ALL_KINDS.format(cone=cone, iterations=100))
    sim = SimCfg(njmax=64, nconmax=16, tolerance=1e-8)
    world = World(model, num_envs=NUM_ENVS, sim=sim, device="cuda")
    generator = torch.Generator(device="cuda").manual_seed(0)
    world.qpos_EL[:, 2] -= 0.02 * torch.rand(NUM_ENVS, generator=generator, device="cuda")
    world.qpos_EL[:, 7:9] += 0.4 * torch.randn(NUM_ENVS, 2, generator=generator, device="cuda")
    world.qvel_EL.copy_(0.7 * torch.randn(world.qvel_EL.shape, generator=generator, device="cuda"))
    world.qpos_EL[-1, 2] = 1.0
    return world


@pytest.mark.gpu
@pytest.mark.parametrize("cone", CONES)
def test_solutions_are_those_of_mujoco_warp(cone):
    world = worlds(cone)
    model, data = world.warp_model, world.warp_data_E
    found = []
    with wp.ScopedDevice("cuda"):
        mjw.fwd_position(model, data, factorize=False)
        mjw.fwd_velocity(model, data)
        mjw.fwd_actuation(model, data)
        mjw.fwd_acceleration(model, data, factorize=True)
        for solve in (
            partial(mjw.solve, model, data),
            *(newton.solver(model, data, rows_on_chip=rows) for rows in ROWS_ON_CHIP),
        ):
            for _ in range(2):  # the second is ordered by the first
                world.qacc_EL.zero_()
                solve()
            wp.synchronize()
            found.append((world.qacc_EL.clone(), world.last_substep("solver_niter").clone()))
    (qacc_EL, iterations_E), *ours = found
    scale_E1 = 1.0 + qacc_EL.abs().amax(-1, keepdim=True)
    for our_qacc_EL, our_iterations_E in ours:
        torch.testing.assert_close(our_qacc_EL / scale_E1, qacc_EL / scale_E1, atol=5e-4, rtol=0)
        assert (our_iterations_E - iterations_E).abs().float().mean() < 0.5


@pytest.mark.gpu
@pytest.mark.parametrize("cone", CONES)
def test_a_far_warm_start_leaves_no_trace(cone):
    world, found = worlds(cone), []
    model, data = world.warp_model, world.warp_data_E
    with wp.ScopedDevice("cuda"):
        mjw.fwd_position(model, data, factorize=False)
        mjw.fwd_velocity(model, data)
        mjw.fwd_actuation(model, data)
        mjw.fwd_acceleration(model, data, factorize=True)
        solve = newton.solver(model, data)
        for far in (0.0, 1e6):
            world.view("qacc_warmstart").fill_(far)
            solve()
            wp.synchronize()
            found.append(world.qacc_EL.clone())
    scale_E1 = 1.0 + found[0].abs().amax(-1, keepdim=True)
    torch.testing.assert_close(found[1] / scale_E1, found[0] / scale_E1, atol=5e-4, rtol=0)
