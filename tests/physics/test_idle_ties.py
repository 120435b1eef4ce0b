"""Rows of ties that no joint can do anything about exert nothing, as in the C engine."""

import mujoco
import pytest

from tests.physics.beside_c import KERNELS, check, started

XML = """
<mujoco>
  <option jacobian="{jacobian}"/>
  <worldbody>
    <body name="hand" mocap="true" pos="0.1 0.2 0.3"/>
    <body name="post" pos="0 1 0" quat="0.4 0.8 -0.2 0.4"><geom size="0.1"/></body>
    <body><joint type="slide" axis="1 2 3"/><geom size="0.05"/>
      <body name="tool" quat="-0.03 -0.47 -0.87 0.08"><geom size="0.05"/></body></body>
  </worldbody>
  <equality>{tie}</equality>
</mujoco>
"""
TIES = {
    "slide": '<weld body1="tool"/>',
    "mocap": '<weld body1="hand" body2="tool"/>',
    "fixed": '<weld body1="post" relpose="0 0 0 0.9 0.1 0 0"/><connect body1="post" anchor="1 1 1"/>',
    "fixed to mocap": '<weld body1="hand" body2="post" relpose="0 0 0 0.9 0.1 0 0"/>',
}


@pytest.mark.parametrize("kernels", ("our solver", "theirs"))
@pytest.mark.parametrize("jacobian", ("dense", "sparse"))
@pytest.mark.parametrize("tie", TIES)
def test_what_no_joint_can_move_feels_no_force(tie: str, jacobian: str, kernels: str) -> None:
    world, mj_data, in_c = started(XML.format(jacobian=jacobian, tie=TIES[tie]), KERNELS[kernels])
    names = ("qacc", "cfrc_ext", "cfrc_int")
    for name in names:
        world.view(name)
    world.step(1)
    mujoco.mj_forward(in_c, mj_data)
    mujoco.mj_rnePostConstraint(in_c, mj_data)
    check(world, mj_data, names)
    # MuJoCo Warp makes rows of ties of what is fixed, for which there must be room.
    assert world.overflow_report().ok
