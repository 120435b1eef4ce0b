import copy

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.physics.fields import write_fields
from ksim_rl.physics.ray_casting import RayBatch

# A table with a lamp that is welded to it, a ball over it, and a cart that a mocap body carries.
TABLE = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="table" pos="0 0 .35" quat="1 0 0 .2">
      <geom name="top" type="box" size="1 1 .05"/>
      <body name="lamp" pos=".5 0 .1" quat="1 .1 0 0"><geom name="shade" size=".05" pos="0 0 .05"/></body>
    </body>
    <body name="hand" mocap="true" pos="3 0 1">
      <geom name="palm" size=".1" pos="0 .1 0" contype="0" conaffinity="0"/>
      <body pos="0 0 .3"><geom name="finger" size=".05" pos=".1 0 0" contype="0" conaffinity="0"/></body>
    </body>
    <body name="ball" pos="0 0 .6"><freejoint/><geom name="skin" size=".1" mass="1"/></body>
  </worldbody>
</mujoco>
"""
MOVING = ("body_pos", "body_quat", "geom_pos", "geom_quat")


def tables(one_kernel: bool, fields: tuple[str, ...] = MOVING) -> World:
    sim = SimCfg(one_kernel_dynamics=one_kernel, njmax=40, nconmax=20)
    return World(load_model(TABLE), num_envs=2, sim=sim, per_world_fields=fields)


def in_c(world: World, row: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The C engine's model with the fields of one world, and its data at rest."""
    changed = copy.copy(world.mj_model)
    write_fields(
        changed, {name: field[row].numpy() for name, field in world.per_world_fields().items()}
    )
    mj_data = mujoco.MjData(changed)
    mujoco.mj_setConst(changed, mj_data)
    mujoco.mj_resetData(changed, mj_data)
    mujoco.mj_forward(changed, mj_data)
    return changed, mj_data


@pytest.mark.parametrize("one_kernel", [False, True])
@pytest.mark.parametrize("field", MOVING)
def test_geoms_fixed_to_the_world_are_where_the_fields_of_each_world_put_them(one_kernel, field):
    """MuJoCo Warp places them once, for all worlds; mocap bodies and what they carry stay right too."""
    world = tables(one_kernel, (field,))
    torch.manual_seed(0)
    world.field(field).add_(0.2 * torch.randn(world.field(field).shape))
    if field.endswith("quat"):
        world.field(field).div_(world.field(field).norm(dim=-1, keepdim=True))
    world.set_const((field,))
    world.reset(torch.ones(2, dtype=torch.bool))
    world.refresh()
    first_EL = world.geom_xpos_EL[0].clone()
    for row in range(2):
        _, mj_data = in_c(world, row)
        np.testing.assert_allclose(world.geom_xpos_EL[row], mj_data.geom_xpos, atol=2e-6)
        expected = mj_data.geom_xmat.reshape(-1, 3, 3)
        np.testing.assert_allclose(world.geom_xmat_EL[row], expected, atol=2e-6)
    if field != "geom_quat":
        assert not torch.allclose(first_EL, world.geom_xpos_EL[1], atol=0.05)


@pytest.mark.parametrize("one_kernel", [False, True])
@pytest.mark.parametrize("moved", ["body_pos", "geom_pos"])
def test_a_ball_lies_on_the_table_of_its_own_world(one_kernel, moved):
    world = tables(one_kernel, (moved,))
    element = world.mj_model.body("table") if moved == "body_pos" else world.mj_model.geom("top")
    world.field(moved)[0, element.id, 2] -= 0.2
    world.set_const((moved,))
    for _ in range(20):
        world.step(10)
    for row in range(2):
        changed, mj_data = in_c(world, row)
        mujoco.mj_step(changed, mj_data, 200)
        np.testing.assert_allclose(world.qpos_EL[row], mj_data.qpos, atol=2e-4)
    assert world.qpos_EL[1, 2] - world.qpos_EL[0, 2] > 0.19


def test_rays_meet_the_table_of_their_own_world():
    world = tables(False, ("body_pos",))
    world.field("body_pos")[0, world.mj_model.body("table").id, 2] -= 0.2
    world.set_const(("body_pos",))
    world.refresh()
    rays = RayBatch(world, 1, geom_groups=(0,))
    rays.start_EN3.copy_(torch.tensor([-0.5, -0.5, 2.0]).expand(2, 1, 3))
    rays.direction_EN3.copy_(torch.tensor([0.0, 0.0, -1.0]).expand(2, 1, 3))
    rays.cast()
    np.testing.assert_allclose(rays.distance_EN[0] - rays.distance_EN[1], 0.2, atol=1e-5)


def test_worlds_that_share_these_fields_launch_nothing_for_them():
    assert tables(False, ("geom_friction",))._substeps._place_fixed_geoms is None
