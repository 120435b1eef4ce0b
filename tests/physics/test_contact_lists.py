"""The lists of each world's contacts, against the C engine's order."""

import numpy as np
import pytest
import warp as wp

from ksim_rl.physics import World
from ksim_rl.physics.rows.contact_lists import ContactLists
from tests.physics.row_models import NUM_ENVS, in_c, permute_pool, touching


@pytest.fixture(scope="module")
def world() -> World:
    return touching("elliptic")


def listed(world: World, lists: ContactLists) -> list[np.ndarray]:
    with wp.ScopedDevice("cpu"):
        lists.append()
        lists.order()
    return [ids[:count] for ids, count in zip(lists.ids.numpy(), lists.count.numpy(), strict=True)]


def test_contacts_are_those_of_the_c_engine_in_its_order(world: World):
    found = listed(world, ContactLists(world.warp_model, world.warp_data_E))
    contact = world.warp_data_E.contact
    assert len(found[-1]) == 1 and min(len(ids) for ids in found[:-1]) > 5
    for row in range(NUM_ENVS):
        mj_data = in_c(world, "elliptic", row)[1]
        np.testing.assert_array_equal(contact.geom.numpy()[found[row]], mj_data.contact.geom)
        np.testing.assert_allclose(
            contact.dist.numpy()[found[row]], mj_data.contact.dist, atol=2e-5
        )
        assert (contact.worldid.numpy()[found[row]] == row).all()


def test_places_in_the_pool_do_not_matter(world: World):
    contact, lists = world.warp_data_E.contact, ContactLists(world.warp_model, world.warp_data_E)
    before = [contact.pos.numpy()[ids] for ids in listed(world, lists)]
    for seed in range(3):
        permute_pool(world, seed)
        for ids, positions in zip(listed(world, lists), before, strict=True):
            np.testing.assert_array_equal(contact.pos.numpy()[ids], positions)


def test_a_full_list_keeps_as_many_as_it_has_room_for(world: World):
    lists = ContactLists(world.warp_model, world.warp_data_E)
    needed = [len(ids) for ids in listed(world, lists)]
    small = ContactLists(world.warp_model, world.warp_data_E, room=3)
    found = listed(world, small)
    assert [len(ids) for ids in found] == [min(count, 3) for count in needed]
    assert all(len(np.unique(ids)) == len(ids) for ids in found)
