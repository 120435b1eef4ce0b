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
PLACES = (
    newton.Placement(rows_on_chip=64),
    newton.Placement(rows_on_chip=8, worlds_per_block=2),
    newton.Placement(rows_on_chip=0, longest_first=False),
)


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
            *(newton.solver(model, data, place=p) for p in PLACES),
        ):
            for _ in range(2):  # the second is ordered by the first
                world.qacc_EL.zero_()
                solve()
            wp.synchronize()
            found.append((world.qacc_EL.clone(), world.view("solver_niter").clone()))
    (qacc_EL, iterations_E), *ours = found
    scale_E1 = 1.0 + qacc_EL.abs().amax(-1, keepdim=True)
    for our_qacc_EL, our_iterations_E in ours:
        torch.testing.assert_close(our_qacc_EL / scale_E1, qacc_EL / scale_E1, atol=5e-4, rtol=0)
        assert (our_iterations_E - iterations_E).abs().float().mean() < 0.5
