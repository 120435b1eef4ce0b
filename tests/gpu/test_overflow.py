"""Overflows on the GPU: each is reported, by eager substeps and by replays of their graphs."""

import pytest

from tests.physics.overflowing_models import SCENES
from tests.physics.test_overflow import check_overflows

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("ours", [True, False])
@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: "-".join(map(str, scene)))
def test_each_overflow_is_told_in_scenes_of_every_kind(scene, ours):
    check_overflows(scene, ours=ours, device="cuda", num_envs=64)
