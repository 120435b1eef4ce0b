"""The one kernel of all constraint rows, against the C engine and against MuJoCo Warp's own kernels."""

import dataclasses
import functools

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, upstream
from ksim_rl.physics.rows import constraint_rows as rows
from ksim_rl.physics.rows.contact_lists import ContactLists
from tests.physics.row_models import NUM_ENVS, in_c, mj_model, permute_pool, touching

CONES = ("pyramidal", "elliptic")
COUNTS = ("ne", "nf", "nl", "nefc")
COLUMNS = ("type", "D", "aref", "frictionloss", "pos", "margin", "vel")


@functools.cache
def world_of(cone: str) -> World:
    return touching(cone)


def launch(world: World, **changes) -> ContactLists:
    """Make the rows of a world, with other options, in arrays that hold rubbish."""
    m = dataclasses.replace(
        world.warp_model, opt=dataclasses.replace(world.warp_model.opt, **changes)
    )
    for name in (*COLUMNS, "J", "J_colind", "J_rowadr", "J_rownnz", "id"):
        getattr(world.warp_data_E.efc, name).fill_(77)
    contact = world.warp_data_E.contact
    may_have_rows = contact.type.numpy()[:, None] & int(upstream.ContactType.CONSTRAINT) != 0
    # What only a sensor measures is left as the collision pass wrote it.
    contact.efc_address.assign(np.where(may_have_rows, 77, np.full(contact.efc_address.shape, -1)))
    with wp.ScopedDevice("cpu"):
        lists = ContactLists(m, world.warp_data_E)
        rows.constraint_rows(m, world.warp_data_E, lists)()
    return lists


def made(world: World, row: int) -> dict[str, np.ndarray]:
    """Return what has been made of a world, with J in full."""
    efc, d = world.warp_data_E.efc, world.warp_data_E
    count = min(int(d.nefc.numpy()[row]), d.njmax)
    found = {name: getattr(efc, name).numpy()[row][:count].copy() for name in (*COLUMNS, "id")}
    found["J"] = np.zeros((count, d.qvel.shape[1]), np.float32)
    columns, values = efc.J_colind.numpy()[row].ravel(), efc.J.numpy()[row].ravel()
    for each, (begin, size) in enumerate(
        zip(efc.J_rowadr.numpy()[row][:count], efc.J_rownnz.numpy()[row][:count], strict=True)
    ):
        found["J"][each, columns[begin : begin + size]] = values[begin : begin + size]
    return found


def bits(world: World) -> list[np.ndarray]:
    """Return all that has been made, but for the contacts' places in the pool."""
    found = [getattr(world.warp_data_E, name).numpy().copy() for name in (*COUNTS, "overflow")]
    for row in range(NUM_ENVS):
        found += [array for name, array in made(world, row).items() if name != "id"]
    return found


@pytest.mark.parametrize("cone", CONES)
def test_rows_are_those_of_the_c_engine_in_its_order(cone: str):
    world = world_of(cone)
    lists, kinds, dims, in_gap = launch(world), set(), set(), 0
    for row in range(NUM_ENVS):
        mj_data, found = in_c(world, cone, row)[1], made(world, row)
        for name in COUNTS:
            assert getattr(world.warp_data_E, name).numpy()[row] == getattr(mj_data, name), name
        # MuJoCo Warp, as we do, writes the margin of a tangent too, whose position is 0.
        found["pos"], mj_data.efc_pos[:] = (
            found["pos"] - found["margin"],
            mj_data.efc_pos - mj_data.efc_margin,
        )
        for name in ("type", "frictionloss"):
            np.testing.assert_allclose(
                found[name], getattr(mj_data, f"efc_{name}"), atol=1e-7, err_msg=name
            )
        for name, atol in (("J", 1e-6), ("pos", 2e-6), ("vel", 1e-5)):
            theirs = getattr(mj_data, f"efc_{name}").reshape(found[name].shape)
            np.testing.assert_allclose(found[name], theirs, atol=atol, err_msg=name)
        for name in ("D", "aref"):
            theirs = getattr(mj_data, f"efc_{name}")
            np.testing.assert_allclose(found[name], theirs, rtol=1e-3, atol=0.02, err_msg=name)
        place = np.flatnonzero(
            found["type"] < int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
        )
        np.testing.assert_array_equal(found["id"][place], mj_data.efc_id[place])
        ids = lists.ids.numpy()[row][: lists.count.numpy()[row]]
        np.testing.assert_array_equal(found["id"][place.size :], ids[mj_data.efc_id[place.size :]])
        addresses = world.warp_data_E.contact.efc_address.numpy()[ids]
        np.testing.assert_array_equal(addresses[:, 0], mj_data.contact.efc_address)
        steps = np.arange(addresses.shape[1])
        rows_of_each = (mj_data.efc_id[place.size :, None] == np.arange(len(ids))).sum(0)
        expected = np.where(steps < rows_of_each[:, None], addresses[:, :1] + steps, -1)
        np.testing.assert_array_equal(addresses, expected)
        in_gap += (addresses[:, 0] == -1).sum()
        kinds |= set(found["type"])
        dims |= set(mj_data.contact.dim)
    assert dims == {1, 3, 4, 6} and len(kinds) == 5 and in_gap > 0
    limited = np.concatenate(
        [made(world, row)["id"][made(world, row)["type"] == 3] for row in range(NUM_ENVS)]
    )
    names = {mj_model(cone).joint(joint).name for joint in limited}
    assert names == {"shoulder", "wrist", "rail"}


@pytest.mark.parametrize("cone", CONES)
def test_rows_are_those_of_mujoco_warp(cone: str):
    world = world_of(cone)
    launch(world)
    ours = [made(world, row) for row in range(NUM_ENVS)]
    counts = {name: getattr(world.warp_data_E, name).numpy().copy() for name in COUNTS}
    addresses = world.warp_data_E.contact.efc_address.numpy().copy()
    with wp.ScopedDevice("cpu"):
        mjw.make_constraint(world.warp_model, world.warp_data_E)
    for name in COUNTS:
        np.testing.assert_array_equal(counts[name], getattr(world.warp_data_E, name).numpy())
    # A contact with rows in one has as many in the other.
    theirs_addresses = world.warp_data_E.contact.efc_address.numpy().copy()
    count = int(world.warp_data_E.nacon.numpy()[0])
    np.testing.assert_array_equal(
        addresses[:count] == -1,
        np.where(theirs_addresses[:count] == 77, -1, theirs_addresses[:count]) == -1,
    )
    for row in range(NUM_ENVS):
        theirs = made(world, row)
        order = [
            np.lexsort((np.arange(len(found["id"])), found["id"], found["type"]))
            for found in (ours[row], theirs)
        ]
        for name in (*COLUMNS, "id", "J"):
            ordered = ours[row][name][order[0]], theirs[name][order[1]]
            np.testing.assert_allclose(*ordered, rtol=2e-6, atol=2e-6, err_msg=name)


@pytest.mark.parametrize("cone", CONES)
def test_places_in_the_pool_do_not_change_a_bit(cone: str):
    world = world_of(cone)
    launch(world)
    before = bits(world)
    for seed in range(3):
        permute_pool(world, seed)
        launch(world)
        for ours, other in zip(bits(world), before, strict=True):
            np.testing.assert_array_equal(ours, other)


def test_what_is_switched_off_has_no_rows():
    world, flags = world_of("pyramidal"), mjw.DisableBit
    launch(world)
    all_rows = np.array([getattr(world.warp_data_E, name).numpy() for name in COUNTS])
    for flag, counts in (
        (flags.EQUALITY, [0]),
        (flags.FRICTIONLOSS, [1]),
        (flags.LIMIT, [2]),
        (flags.CONSTRAINT, [0, 1, 2]),
    ):
        launch(world, disableflags=int(flag))
        left = np.array([getattr(world.warp_data_E, name).numpy() for name in COUNTS])
        gone = np.isin(range(4), counts)
        assert (left[gone] == 0).all() and (left[:3][~gone[:3]] == all_rows[:3][~gone[:3]]).all()
    assert (left[3] == 0).all()
    launch(world, disableflags=int(flags.CONTACT))
    np.testing.assert_array_equal(world.warp_data_E.nefc.numpy(), all_rows[:3].sum(0))
    launch(world, disableflags=int(flags.REFSAFE))
    stiff = made(world, 0)["aref"]
    with wp.ScopedDevice("cpu"):
        opt = dataclasses.replace(world.warp_model.opt, disableflags=int(flags.REFSAFE))
        mjw.make_constraint(dataclasses.replace(world.warp_model, opt=opt), world.warp_data_E)
    np.testing.assert_allclose(
        np.sort(stiff), np.sort(made(world, 0)["aref"]), rtol=1e-5, atol=1e-5
    )


def test_rows_beyond_njmax_are_counted_and_not_written():
    world = touching("elliptic", njmax=20)
    needed = [in_c(world, "elliptic", row)[1].nefc for row in range(NUM_ENVS)]
    launch(world)
    np.testing.assert_array_equal(world.warp_data_E.nefc.numpy(), needed)
    kept = [made(world, row) for row in range(NUM_ENVS)]
    roomy = world_of("elliptic")
    launch(roomy)
    assert (
        world.warp_data_E.contact.efc_address.numpy()[: int(world.warp_data_E.nacon.numpy()[0])]
        < 20
    ).all()
    for row in range(NUM_ENVS):
        for name in (*COLUMNS, "J"):
            np.testing.assert_array_equal(
                kept[row][name], made(roomy, row)[name][:20], err_msg=name
            )
    # More contacts than rows: the pool says how many there are, and the report how many rows they take at most.
    d = world.warp_data_E
    with wp.ScopedDevice("cpu"):
        rows.constraint_rows(world.warp_model, d, ContactLists(world.warp_model, d, room=2))()
    beyond = np.array([in_c(world, "elliptic", row)[1].ncon for row in range(NUM_ENVS)]) - 2
    most = d.contact.efc_address.shape[1]
    np.testing.assert_array_equal(d.nefc.numpy()[:-1], 20 + most * beyond[:-1])
    assert d.nefc.numpy()[-1] == needed[-1]
    world.step(1)
    report = world.overflow_report()
    assert report.worlds["NEFC"] == NUM_ENVS - 1 and report.nefc == max(needed)
    assert f"set sim.njmax >= {max(needed)}" in report.messages[0]


def test_a_full_jacobian_is_said_and_drops_the_last_rows():
    world = world_of("pyramidal")
    launch(world)
    whole = [made(world, row) for row in range(NUM_ENVS)]
    d, room = world.warp_data_E, world.warp_data_E.njmax_nnz
    d.njmax_nnz = 100
    try:
        launch(world)
    finally:
        d.njmax_nnz = room
    full = d.overflow.numpy() & int(mjw.OverflowType.NJMAX_NNZ) != 0
    assert full.tolist() == [True] * (NUM_ENVS - 1) + [False]
    d.overflow.zero_()
    for row in range(NUM_ENVS):
        found = made(world, row)
        count = len(found["type"])
        assert (found["J"] != 0).sum() <= 100 and (count < len(whole[row]["type"])) == full[row]
        for name in (*COLUMNS, "J"):
            np.testing.assert_array_equal(found[name], whole[row][name][:count], err_msg=name)
        addresses = d.contact.efc_address.numpy()[: int(d.nacon.numpy()[0])]
        assert addresses[d.contact.worldid.numpy()[: len(addresses)] == row].max(initial=-1) < count


def test_steps_reach_what_mujoco_warps_rows_reach():
    reached = []
    for one_kernel in (True, False):
        world = touching("elliptic")
        assert world.one_kernel_rows_unavailable is None
        if not one_kernel:
            world._substeps.stages = dataclasses.replace(world._substeps.stages, make_rows=None)
        for _ in range(4):
            world.step(2)
        assert (world.warp_data_E.contact.efc_address.numpy() >= 0).any()
        reached.append((world.qpos_EL.clone(), world.qvel_EL.clone()))
    for ours, theirs in zip(*reached, strict=True):
        assert ours.isfinite().all()
        torch.testing.assert_close(ours, theirs, atol=2e-3, rtol=2e-3)


def test_why_a_model_is_out_of_its_range_is_told():
    xml = """<mujoco><worldbody>{}<body name="a"><freejoint/><geom size="0.1"/></body></worldbody>{}</mujoco>"""
    tie = '<equality><connect body1="a" anchor="0 0 0"/></equality>'
    for text, word in ((xml.format("", tie), "tie bodies"), (xml.format("", ""), None)):
        model = mujoco.MjModel.from_xml_string(text)
        world = World(model, num_envs=1, sim=SimCfg(one_kernel_dynamics=True))
        assert world.one_kernel_dynamics_unavailable is None
        assert (word or "None") in str(world.one_kernel_rows_unavailable)
        world.step(1)
    world = World(model, num_envs=1, sim=SimCfg(one_kernel_dynamics=False))
    assert "not one kernel" in str(world.one_kernel_rows_unavailable)
