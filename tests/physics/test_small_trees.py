"""Small branching models, which students build first, beside the C engine."""

import itertools
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World
from ksim_rl.physics.newton.kernel import layout
from ksim_rl.physics.newton.limbs import limbs_of

CART_WITH_TWO_POLES = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body><joint name="cart" type="slide" axis="1 0 0" range="-1 1" limited="true"/><geom size="0.1" mass="1"/>
      <body><joint name="left" axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.1 0 0.5" size="0.03" mass="0.2" contype="0"/></body>
      <body pos="0 0.3 0"><joint name="right" axis="0 1 0" range="-30 30" limited="true"/>
        <geom type="capsule" fromto="0 0 0 -0.1 0 0.4" size="0.03" mass="0.3" contype="0"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="cart" gear="10"/></actuator>
</mujoco>
"""
LIFT_WITH_TWO_FINGERS = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.5"><joint name="lift" type="slide" axis="0 0 1"/><geom size="0.05" mass="0.5"/>
      <body pos="0.1 0 -0.1"><joint name="a" type="slide" axis="1 0 0" range="-0.05 0.05" limited="true"/>
        <geom type="box" size="0.02 0.02 0.1" mass="0.1"/></body>
      <body pos="-0.1 0 -0.1"><joint name="b" type="slide" axis="-1 0 0" range="-0.05 0.05" limited="true"/>
        <geom type="box" size="0.02 0.02 0.1" mass="0.1"/></body>
    </body>
  </worldbody>
  <actuator><position joint="a" kp="20"/><position joint="b" kp="20"/></actuator>
</mujoco>
"""


def _tree(parents: tuple[int, ...]) -> str:
    """A model whose joint i hangs from joint parents[i], or from the world where that is -1."""
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(parents):
        children.setdefault(parent, []).append(joint)

    def body(joint: int) -> str:
        inner = "".join(body(child) for child in children.get(joint, []))
        axis = ("1 0 0", "0 1 0", "0 0 1")[joint % 3]
        return (
            f'<body pos="0.05 {0.02 * joint} -0.1"><joint axis="{axis}" range="-20 20" limited="true" armature="0.01"/>'
            f'<geom size="0.03" pos="0.02 0 -0.05" mass="0.2" contype="0" conaffinity="0"/>{inner}</body>'
        )

    roots = "".join(body(joint) for joint in children[-1])
    return f'<mujoco><option timestep="0.004"/><worldbody>{roots}</worldbody></mujoco>'


# One joint carries ten and eleven others side by side: the trees of 11 and 12 degrees of freedom that are widest.
MODELS = {
    "cart with two poles": CART_WITH_TWO_POLES,
    "lift with two fingers": LIFT_WITH_TWO_FINGERS,
    "two pendulums": _tree((-1, -1)),
    "five joints, then twice three": _tree((-1, 0, 1, 2, 3, 4, 5, 6, 4, 8, 9)),
    "five joints, then three limbs": _tree((-1, 0, 1, 2, 3, 4, 5, 4, 7, 8, 4, 10)),
}


def _trees(nv: int) -> Iterator[tuple[int, ...]]:
    """All trees of nv joints, numbered depth first as MuJoCo numbers them."""
    if nv == 0:
        yield ()
        return
    for before in _trees(nv - 1):
        # The next joint hangs from the last one or from one of its ancestors.
        place = nv - 2
        while place >= 0:
            yield (*before, place)
            place = before[place]
        yield (*before, -1)


@pytest.mark.parametrize("xml", MODELS.values(), ids=MODELS.keys())
def test_a_small_tree_moves_as_in_the_c_engine(xml: str) -> None:
    mj_model = mujoco.MjModel.from_xml_string(xml)
    world = World(mj_model, num_envs=2, sim=SimCfg(tolerance=1e-8, iterations=50))
    assert world.has_one_kernel_solver
    mj_data = mujoco.MjData(mj_model)
    generator = np.random.default_rng(3)
    mj_data.qvel[:] = generator.uniform(-1.0, 1.0, mj_model.nv)
    mj_data.ctrl[:] = 0.02
    world.qvel_EL.copy_(torch.from_numpy(mj_data.qvel).float())
    world.ctrl_EL.fill_(0.02)
    for _ in range(40):
        mujoco.mj_step(mj_model, mj_data)
    world.step(40)
    np.testing.assert_allclose(world.qpos_EL[1].numpy(), mj_data.qpos, atol=2e-4)
    np.testing.assert_allclose(world.qvel_EL[1].numpy(), mj_data.qvel, atol=2e-3)


@pytest.mark.parametrize("nv", range(1, 10))
def test_rows_of_every_small_tree_find_room(nv: int) -> None:
    for parents, njmax in itertools.product(_trees(nv), (1, 4, 7)):
        limbs = limbs_of(parents)
        sizes = layout(nv, njmax, limbs, ntendon=0, elliptic=False, rows_in_shared=njmax)
        assert sizes["NARROW"] <= sizes["STRIDE"], (parents, njmax)
