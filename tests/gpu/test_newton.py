"""The one-kernel solver on a GPU, where a warp shares a world, against MuJoCo Warp's own solver."""

from functools import partial

import mujoco_warp as mjw
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.physics.newton import solver as newton
from tests.physics.rows_of_all_kinds import CONES, ROWS_OF_ALL_KINDS

NUM_ENVS = 300
ROWS_IN_SHARED = (64, 8, 0)


# Joints of the spine and of each limb: lanes sum tiles of a quadruped's Hessian, and rows of a humanoid's.
ROBOTS = {"quadruped": (0, (3, 3, 2, 3)), "biped": (0, (6, 5)), "humanoid": (3, (6, 6, 7, 7))}


def robot(cone: str, spine: int, limbs: tuple[int, ...]) -> str:
    """Return a robot that stands on its limbs, each of 0.4 m, at whose ends are feet."""
    joint = '<joint axis="{} {} 0.2" range="-0.3 0.3" limited="true" frictionloss="0.05" armature="0.01"/>'
    link = '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 {}" mass="0.3" contype="0" conaffinity="0"/>'
    hanging = ""
    for index, joints in enumerate(limbs):
        end = f"0 0 {-0.4 / joints}"
        chain = f'<geom size="0.04" pos="{end}" contype="2"/>'
        for number in range(joints):
            place = end if number + 1 < joints else f"{0.2 * index} {0.3 * (index % 2)} 0"
            body = joint.format(number % 2, (number + 1) % 2) + link.format(-0.4 / joints)
            chain = f'<body pos="{place}">{body}{chain}</body>'
        hanging += chain
    for number in range(spine):
        hanging = f'<body>{joint.format(number % 2, (number + 1) % 2)}<geom size="0.1" contype="0"/>{hanging}</body>'
    return f"""
    <mujoco>
      <option timestep="0.004" integrator="implicitfast" iterations="100" tolerance="1e-8" cone="{cone}" impratio="3"/>
      <default><geom condim="{6 if cone == "elliptic" else 3}" friction="0.8 0.02 0.01"/></default>
      <worldbody>
        <geom type="plane" size="5 5 1"/>
        <body pos="0 0 0.435"><freejoint/><geom size="0.1" contype="0"/>{hanging}</body>
      </worldbody>
    </mujoco>"""


def standing(cone: str, name: str) -> World:
    world = World(
        load_model(robot(cone, *ROBOTS[name])),
        num_envs=NUM_ENVS,
        sim=SimCfg(njmax=96, nconmax=16),
        device="cuda",
    )
    generator = torch.Generator(device="cuda").manual_seed(0)
    world.qpos_EL[:, 7:] += 0.2 * torch.randn(
        world.qpos_EL[:, 7:].shape, generator=generator, device="cuda"
    )
    world.qvel_EL.copy_(0.7 * torch.randn(world.qvel_EL.shape, generator=generator, device="cuda"))
    return world


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


def check_solutions(world: World) -> None:
    """Solve with rows in shared memory and beyond: as MuJoCo Warp's solver does, and twice with the same bits."""
    model, data = world.warp_model, world.warp_data_E
    found = []
    with wp.ScopedDevice("cuda"):
        mjw.fwd_position(model, data, factorize=False)
        mjw.fwd_velocity(model, data)
        mjw.fwd_actuation(model, data)
        mjw.fwd_acceleration(model, data, factorize=True)
        for solve in (
            partial(mjw.solve, model, data),
            *(newton.solver(model, data, rows_in_shared=rows) for rows in ROWS_IN_SHARED),
        ):
            twice = []
            for _ in range(2):  # the second is ordered by the first
                world.qacc_EL.zero_()
                solve()
                wp.synchronize()
                twice.append(world.qacc_EL.clone())
            found.append((twice, world.last_substep("solver_niter").clone()))
    ((_, qacc_EL), iterations_E), *ours = found
    scale_E1 = 1.0 + qacc_EL.abs().amax(-1, keepdim=True)
    for twice, our_iterations_E in ours:
        torch.testing.assert_close(twice[1] / scale_E1, qacc_EL / scale_E1, atol=5e-4, rtol=0)
        assert torch.equal(*twice)
        # Which of them takes fewer differs by world, and with the order of contacts.
        assert (our_iterations_E - iterations_E).float().mean().abs() < 0.35


@pytest.mark.gpu
@pytest.mark.parametrize("cone", CONES)
def test_solutions_are_those_of_mujoco_warp(cone):
    check_solutions(worlds(cone))


@pytest.mark.gpu
@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("name", ROBOTS)
def test_solutions_of_robots_are_those_of_mujoco_warp(name, cone):
    check_solutions(standing(cone, name))


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
