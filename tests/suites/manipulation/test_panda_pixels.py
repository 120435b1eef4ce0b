"""The Panda that sees its cube: what it reads, and that pictures show the cube where it is."""

import pytest
import torch

from ksim_rl import envs
from ksim_rl.suites.manipulation.panda_pixels import panda_pick_cube_pixels
from tests.absent_models import skipped_without_models


@pytest.mark.full
def test_pictures_show_the_cube_and_nothing_else_tells_where_it_is():
    with skipped_without_models():
        env = envs.make("panda_pick_cube_pixels", num_envs=16, seed=0)
    root = env.reset()
    rgb_EHWC = root["front"]
    assert rgb_EHWC.shape == (16, 64, 64, 3) and rgb_EHWC.dtype == torch.uint8
    box_E3 = env.base_env.view.body("box").pos_EL
    # No number that the policy reads changes with the cube alone.
    read = set(panda_pick_cube_pixels().observations["actor"].terms)
    assert not {name for name in read if "box" in name}
    # The cube's columns: right in the picture is along y, from 1 m away 12 mm per pixel.
    red, green, blue = rgb_EHWC.int().unbind(-1)
    is_cube_EHW = (green > red + 40) & (green > blue + 40)
    seen_E = is_cube_EHW.sum((1, 2)) >= 2
    assert int(seen_E.sum()) >= 12
    columns_W = torch.arange(64.0)
    column_E = (is_cube_EHW.sum(1) * columns_W).sum(-1) / is_cube_EHW.sum((1, 2)).clamp_min(1)
    pair = torch.stack([column_E, box_E3[:, 1]])[:, seen_E]
    assert float(torch.corrcoef(pair)[0, 1]) > 0.95
    env.close()
