"""A program's filter of contacts stands beside ours, from which contacts of height fields come."""

import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model

BALL_ON_FIELD = """
<mujoco>
  <option timestep="0.002"/>
  <asset><hfield name="even" nrow="4" ncol="4" size="1 1 0.1 0.1" elevation="0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1"/></asset>
  <worldbody>
    <geom type="hfield" hfield="even"/>
    <body pos="0 0 0.11"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("ours", [False, True])
def test_a_ball_stays_on_a_height_field_while_a_program_filters_contacts(ours):
    world = World(load_model(BALL_ON_FIELD), num_envs=2, sim=SimCfg(one_kernel_dynamics=ours))
    seen = []
    world.step(2)
    assert world.plan.callbacks == ()
    world.warp_model.callback.contactfilter = lambda m, d: seen.append(int(d.nacon.numpy()[0]))
    assert world.plan.callbacks == ("contactfilter",)
    world.step(200)
    assert len(seen) == 200 and seen[-1] == 4, (
        "it sees the contacts that ours has found: with two prisms each"
    )
    world.warp_model.callback.contactfilter = None
    assert world.plan.callbacks == ()
    for _ in range(20):
        world.step(10)
    assert len(seen) == 200
    torch.testing.assert_close(world.qpos_EL[:, 2], torch.full((2,), 0.1), atol=2e-3, rtol=0.0)
