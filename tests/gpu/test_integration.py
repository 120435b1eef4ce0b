"""The one kernel that integrates a substep on a GPU, where lanes of a warp share a world."""

import mujoco_warp as mjw
import pytest
import torch
import warp as wp

from ksim_rl.physics import World
from ksim_rl.physics.smooth import stages
from tests.gpu.test_smooth import LANES, NUM_ENVS, worlds
from tests.physics.test_integration import STATE, WRITTEN


def solved() -> tuple[World, dict[str, torch.Tensor]]:
    """Worlds at the end of the solver, and their state."""
    world = worlds()
    state = {name: world.last_substep(name).clone() for name in STATE}
    world.step(1)
    return world, state


def results(
    world: World, state: dict[str, torch.Tensor], lanes: int | None
) -> dict[str, torch.Tensor]:
    for name, rows in state.items():
        world.last_substep(name).copy_(rows)
    world.last_substep("qacc_warmstart").fill_(7.0)
    with wp.ScopedDevice("cuda"):
        if lanes is None:
            mjw.implicit(world.warp_model, world.warp_data_E)
        else:
            stages.integration(world.warp_model, world.warp_data_E, lanes=lanes)()
        wp.synchronize()
    return {name: world.last_substep(name).clone() for name in WRITTEN}


@pytest.mark.gpu
def test_all_numbers_of_lanes_give_the_same_bits_which_are_those_of_mujoco_warp():
    world, state = solved()
    assert world.one_kernel_integration_unavailable is None
    first, *others = (results(world, state, lanes) for lanes in (*LANES, *LANES))
    theirs = results(world, state, None)
    for name, ours in first.items():
        for other in others:
            assert torch.equal(other[name], ours), name
        scale = 1.0 + theirs[name].abs().max()
        torch.testing.assert_close(ours / scale, theirs[name] / scale, atol=3e-6, rtol=0, msg=name)


@pytest.mark.gpu
def test_what_is_not_finite_stays_in_its_world_bit_for_bit():
    world, state = solved()
    clean = results(world, state, 8)
    state["qvel"][1] = torch.nan
    spoilt = results(world, state, 8)
    others = torch.arange(NUM_ENVS, device="cuda") != 1
    assert spoilt["qvel"][1].isnan().all()
    for name, ours in clean.items():
        assert torch.equal(spoilt[name][others], ours[others]), name


@pytest.mark.gpu
def test_steps_without_contacts_have_the_same_bits_in_every_run():
    reached = []
    for _ in range(2):
        world = worlds()
        for _ in range(4):
            world.step(4)
        reached.append({name: world.view(name).clone() for name in ("qpos", "qvel", "act", "qacc")})
    assert reached[0]["qpos"].isfinite().all()
    for name, ours in reached[0].items():
        assert torch.equal(ours, reached[1][name]), name
