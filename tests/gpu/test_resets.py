"""Resets on a GPU, against MuJoCo Warp's own."""

import pytest

from tests.physics.test_resets import MAKES, check


@pytest.mark.gpu
@pytest.mark.parametrize("make", MAKES)
def test_it_leaves_all_arrays_as_mujoco_warp_does(make):
    check(make, "cuda")
