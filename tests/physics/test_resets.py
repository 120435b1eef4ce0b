"""Resets, against MuJoCo Warp's own."""

from collections.abc import Callable

import mujoco_warp as mjw
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model, views
from tests.physics.models import standing_quadrupeds

# A body that a mocap body carries on a weld, beside one that falls: more than our kernels reset.
WELDED = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="hand" mocap="true" pos="1 0 1"/>
    <body name="held" pos="1 0 1"><freejoint/><geom size="0.1"/></body>
    <body name="ball" pos="0 0 0.09"><freejoint/><geom size="0.1"/></body>
  </worldbody>
  <equality><weld body1="hand" body2="held"/></equality>
</mujoco>
"""


def welded(device: str = "cpu") -> World:
    world = World(load_model(WELDED), num_envs=4, sim=SimCfg(njmax=40, nconmax=20), device=device)
    world.view("mocap_pos")[:, 0, 2] = 2.0
    world.step(5)
    return world


MAKES = (standing_quadrupeds, welded)


def check(make: Callable[..., World], device: str) -> None:
    """Compare all arrays after a reset of some worlds."""
    world, theirs = make(device=device), make(device=device)
    mask_E = torch.tensor([False, True, False, True], device=device)
    arrays = views.arrays(world.warp_data_E), views.arrays(theirs.warp_data_E)
    before = {name: wp.to_torch(array).clone() for name, array in arrays[0].items()}
    for name, array in arrays[1].items():
        wp.to_torch(array).copy_(before[name])
    world.reset(mask_E)
    with wp.ScopedDevice(device):
        mjw.reset_data(theirs.warp_model, theirs.warp_data_E, reset=wp.from_torch(mask_E))
        wp.synchronize()
    assert int(wp.to_torch(arrays[0]["nacon"])) > 0
    for name, array in arrays[0].items():
        found, expected = wp.to_torch(array), wp.to_torch(arrays[1][name])
        if name in views.ACCELERATION_STAGE:
            assert not found[mask_E].any() and torch.equal(found[~mask_E], before[name][~mask_E]), (
                name
            )
        else:
            assert torch.equal(found, expected), name
    qpos0_L = torch.from_numpy(world.mj_model.qpos0).float().to(device)
    assert (world.qpos_EL[mask_E] == qpos0_L).all()
    assert not torch.equal(world.qpos_EL[~mask_E], world.qpos_EL[mask_E])


@pytest.mark.parametrize("make", MAKES)
def test_it_leaves_all_arrays_as_mujoco_warp_does(make):
    check(make, "cpu")
