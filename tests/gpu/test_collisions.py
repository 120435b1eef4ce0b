"""Our collision pass on a GPU, where lanes of a warp share a world."""

import pytest

from tests.physics.models import standing_quadrupeds
from tests.physics.test_collisions import check, check_against_c, pile


@pytest.mark.gpu
@pytest.mark.parametrize("lanes", [4, 16, 32])
@pytest.mark.parametrize("make", [pile, standing_quadrupeds])
def test_all_numbers_of_lanes_find_the_contacts_of_mujoco_warp(make, lanes):
    check(make(device="cuda"), lanes=lanes)


@pytest.mark.gpu
@pytest.mark.parametrize("lanes", [4, 16, 32])
def test_contacts_of_known_types_are_those_of_the_c_engine(lanes):
    check_against_c(device="cuda", lanes=lanes)
