"""The collision pass with our broad phase finds the contacts that MuJoCo Warp's finds."""

import mujoco_warp as mjw
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.physics.collision.collisions import broad_phase_unavailable, collisions
from tests.physics.models import standing_quadrupeds

# All ways in which a pair may pass or not: planes first and second, boxes whose spheres overlap though they are apart,
# margins, gaps, an explicit pair with a margin of its own, and a sensor that measures a pair wherever it is.
PILE = """
<mujoco>
  <worldbody>
    <body name="roof" pos="0 0 3"><geom name="roof" type="plane" size="5 5 1" euler="180 0 0"/></body>
    <geom name="floor" type="plane" size="5 5 1" margin="0.02" gap="0.01"/>
    {bodies}
  </worldbody>
  <contact><pair geom1="g0" geom2="g1" margin="0.3" gap="0.1"/><exclude body1="b2" body2="b3"/></contact>
  <sensor><distance geom1="g1" geom2="g4" cutoff="9"/></sensor>
</mujoco>
"""
SHAPES = (
    'type="box" size="0.3 0.05 0.02"',
    'type="capsule" size="0.05 0.2" margin="0.05"',
    'type="sphere" size="0.1"',
    'type="ellipsoid" size="0.1 0.2 0.05"',
    'type="cylinder" size="0.1 0.1"',
)
NUM_ENVS = 24


def pile(device: str = "cpu") -> World:
    bodies = "".join(
        f'<body name="b{k}" pos="0 0 1"><freejoint/><geom name="g{k}" {SHAPES[k % len(SHAPES)]}/></body>'
        for k in range(12)
    )
    world = World(
        load_model(PILE.format(bodies=bodies)),
        num_envs=NUM_ENVS,
        sim=SimCfg(njmax=300, nconmax=150),
        device=device,
    )
    generator = torch.Generator().manual_seed(0)
    qpos_EL = torch.randn(world.qpos_EL.shape, generator=generator).unflatten(1, (-1, 7))
    qpos_EL[..., :3] *= 0.3
    qpos_EL[..., 2] += 1.0
    qpos_EL[::2, :3, 2] = 2.95
    qpos_EL[1::2, :3, 2] = 0.05
    world.qpos_EL.copy_(qpos_EL.flatten(1))
    world.refresh()
    return world


def found(world: World) -> tuple[int, dict[tuple[int, int, int], torch.Tensor]]:
    """Return how many pairs passed, and distances and positions of contacts by world and pair."""
    d = world.warp_data_E
    number = int(wp.to_torch(d.nacon)[0])
    where = torch.cat(
        [wp.to_torch(d.contact.worldid)[:number, None], wp.to_torch(d.contact.geom)[:number]], 1
    )
    what = torch.cat([wp.to_torch(d.contact.dist)[:number, None], wp.to_torch(d.contact.pos)[:number]], 1)
    contacts: dict[tuple[int, int, int], torch.Tensor] = {}
    for key in {tuple(row) for row in where.tolist()}:
        of_pair = what[(where == torch.tensor(key, device=where.device)).all(1)]
        contacts[key] = of_pair[of_pair[:, 1].argsort()]
    return int(wp.to_torch(d.ncollision)[0]), contacts


def check(world: World, **kwargs: int) -> None:
    m, d = world.warp_model, world.warp_data_E
    assert broad_phase_unavailable(m, d) is None
    with wp.ScopedDevice(str(world.device)):
        mjw.collision(m, d)
        wp.synchronize()
        num_pairs, expected = found(world)
        collisions(m, d, **kwargs)()
        wp.synchronize()
    num_own_pairs, contacts = found(world)
    assert num_own_pairs == num_pairs and contacts.keys() == expected.keys()
    assert len(expected) > world.num_envs
    for key, own in contacts.items():
        torch.testing.assert_close(own, expected[key], msg=str(key))


@pytest.mark.parametrize("make", [pile, standing_quadrupeds])
def test_it_finds_the_contacts_of_mujoco_warp(make):
    check(make())


def test_more_pairs_than_there_is_room_for_are_counted():
    world = pile()
    d = world.warp_data_E
    with wp.ScopedDevice("cpu"):
        mjw.collision(world.warp_model, d)
        num_pairs = int(d.ncollision.numpy()[0])
        d.naconmax = num_pairs // 2
        collisions(world.warp_model, d)()
    assert int(d.ncollision.numpy()[0]) == num_pairs


def test_a_model_outside_of_it_keeps_mujoco_warps():
    world = pile()
    world.warp_model.opt.broadphase = mjw.BroadphaseType.SAP_TILE
    assert "sweeps" in str(broad_phase_unavailable(world.warp_model, world.warp_data_E))
