"""The one kernel of all constraint rows on a GPU, where lanes of a warp share a world and places in the pool vary."""

import mujoco_warp as mjw
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, native
from ksim_rl.physics.rows import constraint_rows as rows
from ksim_rl.physics.rows.contact_lists import ContactLists
from tests.physics.row_models import touching
from tests.physics.test_contact_sensors import model

# Not a multiple of the worlds of a block.
NUM_ENVS = 301
LANES = (4, 8, 16, 32)
COLUMNS = ("type", "D", "aref", "frictionloss", "pos", "margin", "vel", "J_rownnz", "J_rowadr")


def results(world: World, lanes: int) -> dict[str, torch.Tensor]:
    """Make rows in arrays of zeros; places in the pool are left out, as they vary."""
    m, d = world.warp_model, world.warp_data_E
    with wp.ScopedDevice("cuda"):
        for name in (*COLUMNS, "J", "J_colind", "id"):
            getattr(d.efc, name).zero_()
        lists = ContactLists(m, d)
        rows.constraint_rows(m, d, lists, lanes=lanes)()
        wp.synchronize()
    found = {
        name: wp.to_torch(getattr(d.efc, name)).clone() for name in (*COLUMNS, "J", "J_colind")
    }
    found |= {
        name: wp.to_torch(getattr(d, name)).clone()
        for name in ("ne", "nf", "nl", "nefc", "overflow")
    }
    found["dist"] = wp.to_torch(d.contact.dist)[wp.to_torch(lists.ids).long()]
    found["dist"][torch.arange(lists.room, device="cuda") >= wp.to_torch(lists.count)[:, None]] = (
        0.0
    )
    return found


@pytest.mark.gpu
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_all_numbers_of_lanes_and_places_in_the_pool_give_the_same_bits(cone: str):
    world = touching(cone, device="cuda", num_envs=NUM_ENVS)
    first = results(world, LANES[0])
    assert first["nefc"].max() <= world.njmax and not first["overflow"].any()
    for lanes in (*LANES[1:], LANES[0]):
        with wp.ScopedDevice("cuda"):
            # Its threads take other places in the pool.
            mjw.collision(world.warp_model, world.warp_data_E)
        for name, found in results(world, lanes).items():
            assert torch.equal(found, first[name]), f"{name} of {lanes} lanes"


@pytest.mark.gpu
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_rows_are_as_many_as_mujoco_warps_and_sum_up_to_the_same(cone: str):
    world = touching(cone, device="cuda", num_envs=NUM_ENVS)
    ours, d = results(world, 16), world.warp_data_E
    with wp.ScopedDevice("cuda"):
        for name in COLUMNS:
            getattr(d.efc, name).zero_()
        mjw.make_constraint(world.warp_model, d)
        wp.synchronize()
    for name in ("ne", "nf", "nl", "nefc"):
        assert torch.equal(ours[name], wp.to_torch(getattr(d, name))), name
    for name in ("D", "aref", "vel", "pos"):
        theirs = wp.to_torch(getattr(d.efc, name)).double()
        scale = 1.0 + theirs.abs().sum(-1)
        torch.testing.assert_close(
            ours[name].double().sum(-1) / scale, theirs.sum(-1) / scale, atol=1e-5, rtol=0, msg=name
        )


@pytest.mark.gpu
def test_captured_steps_from_one_state_reach_the_same_bits():
    reached = []
    for _ in range(2):
        world = touching("elliptic", device="cuda", num_envs=NUM_ENVS)
        assert world.one_kernel_rows_unavailable is None
        for _ in range(4):
            world.step(4)
        reached.append((world.qpos_EL.clone(), world.qvel_EL.clone()))
    for ours, again in zip(*reached, strict=True):
        assert torch.equal(ours, again)


@pytest.mark.gpu
def test_blocks_of_many_worlds_reach_the_same_bits(monkeypatch):
    reached = []
    for few_worlds in (native.FEW_WORLDS, 0):
        monkeypatch.setattr(native, "FEW_WORLDS", few_worlds)
        sim = SimCfg(njmax=120, nconmax=40, one_kernel_dynamics=True)
        world = World(model("elliptic", ()), num_envs=NUM_ENVS, sim=sim, device="cuda")
        generator = torch.Generator(device="cuda").manual_seed(0)
        world.qpos_EL[:, 2] -= 0.03
        for state, scale in ((world.qpos_EL, 0.05), (world.qvel_EL, 0.5)):
            state.add_(scale * torch.randn(state.shape, generator=generator, device="cuda"))
        world.step(4)
        reached.append(
            [state.clone() for state in (world.qpos_EL, world.qvel_EL, world.sensordata_EL)]
        )
    assert reached[0][2].any()
    for few, many in zip(*reached, strict=True):
        assert torch.equal(few, many)
