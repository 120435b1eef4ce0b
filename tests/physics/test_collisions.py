"""Our own collision pass finds the contacts that MuJoCo Warp's and the C engine's find."""

from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.physics.collision.collisions import (
    MOST_CONTACTS,
    broad_phase_unavailable,
    collisions,
    pairs_left,
)
from ksim_rl.physics.rows.contact_lists import ContactLists
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


def found(world: World) -> dict[tuple[int, int, int], torch.Tensor]:
    """Return distances and positions of contacts by world and pair."""
    d = world.warp_data_E
    number = int(wp.to_torch(d.nacon)[0])
    where = torch.cat(
        [wp.to_torch(d.contact.worldid)[:number, None], wp.to_torch(d.contact.geom)[:number]], 1
    )
    what = torch.cat(
        [wp.to_torch(d.contact.dist)[:number, None], wp.to_torch(d.contact.pos)[:number]], 1
    )
    contacts: dict[tuple[int, int, int], torch.Tensor] = {}
    for key in {tuple(row) for row in where.tolist()}:
        of_pair = what[(where == torch.tensor(key, device=where.device)).all(1)]
        contacts[key] = of_pair[of_pair[:, 1].argsort()]
    return contacts


def check(world: World, **kwargs: int) -> None:
    m, d = world.warp_model, world.warp_data_E
    assert broad_phase_unavailable(m, d) is None
    with wp.ScopedDevice(str(world.device)):
        mjw.collision(m, d)
        wp.synchronize()
        expected = found(world)
        d.nacon.zero_()
        collisions(m, d, ContactLists(m, d), **kwargs)()
        wp.synchronize()
    contacts = found(world)
    assert contacts.keys() == expected.keys()
    assert len(expected) > world.num_envs
    for key, own in contacts.items():
        torch.testing.assert_close(own, expected[key], msg=str(key))


@pytest.mark.parametrize("make", [pytest.param(pile, marks=pytest.mark.full), standing_quadrupeds])
def test_it_finds_the_contacts_of_mujoco_warp(make):
    check(make())


# Every pair of types that the kernel knows, and what contacts take from their geoms or from an explicit pair:
# dimensions, frictions, laws, priorities, margins and gaps.
KNOWN = """
<mujoco>
  <default>
    <geom friction="0.8 0.01 0.002"/>
    <default class="plane"><geom type="plane" size="5 5 1" contype="7" conaffinity="7"/></default>
  </default>
  <worldbody>
    <body euler="0 70 0"><geom class="plane"/></body>
    <geom class="plane" margin="0.03" gap="0.01" condim="1"/>
    <body><freejoint/><geom type="sphere" size="0.1" condim="4" solref="0.01 0.7"/></body>
    <body><freejoint/><geom type="sphere" size="0.07" priority="1" friction="0.3 0.02 0.01"/></body>
    <body><freejoint/><geom name="rod" type="capsule" size="0.05 0.2" margin="0.02" solmix="3"/></body>
    <body><freejoint/><geom type="capsule" size="0.08 0.1" solimp="0.8 0.9 0.01 0.4 3" condim="6"/></body>
    <body><freejoint/>
      <geom name="box" type="box" size="0.1 0.2 0.05" solref="-900 -40" contype="2" conaffinity="1"/>
    </body>
    <body><freejoint/><geom type="box" size="0.2 0.04 0.06" solmix="0" contype="2" conaffinity="1"/></body>
    <body><freejoint/><geom type="cylinder" size="0.12 0.06" contype="4" conaffinity="0"/></body>
  </worldbody>
  <contact>
    <pair geom1="rod" geom2="box" margin="0.04" gap="0.02" condim="4" friction="0.4 0.5 0.01 0.02 0.03"/>
  </contact>
</mujoco>
"""
FIELDS = [
    "dist",
    "pos",
    "frame",
    "includemargin",
    "friction",
    "solref",
    "solreffriction",
    "solimp",
    "dim",
    "geom",
]


def known(device: str = "cpu", num_envs: int = 200) -> World:
    """Worlds in which things of known types lie in each other, in some level or with capsules side by side."""
    world = World(
        load_model(KNOWN), num_envs=num_envs, sim=SimCfg(njmax=400, nconmax=60), device=device
    )
    generator = torch.Generator().manual_seed(0)
    qpos_EL = torch.randn(world.qpos_EL.shape, generator=generator).unflatten(1, (-1, 7))
    qpos_EL[..., :3] = torch.rand(qpos_EL[..., :3].shape, generator=generator) * 0.6 - 0.1
    qpos_EL[::4, ::2, 3:] = torch.tensor([1.0, 0.0, 0.0, 1.0])
    qpos_EL[1::4, 3, 3:] = qpos_EL[1::4, 2, 3:]
    qpos_EL[..., 3:] /= qpos_EL[..., 3:].norm(dim=-1, keepdim=True)
    world.qpos_EL.copy_(qpos_EL.flatten(1))
    world.refresh()
    return world


def contacts_of(contact: Any, chosen: Any) -> np.ndarray:
    fields = [np.asarray(getattr(contact, name))[chosen] for name in FIELDS]
    rows = np.concatenate([field.reshape(len(fields[0]), -1) for field in fields], 1)
    return rows[np.lexsort((rows[:, -1], rows[:, -2]))]


def check_against_c(device: str = "cpu", **kwargs: int) -> None:
    world = known(device)
    m, d = world.warp_model, world.warp_data_E
    assert pairs_left(m) is None
    lists = ContactLists(m, d)
    with wp.ScopedDevice(str(world.device)):
        d.nacon.zero_()
        collisions(m, d, lists, **kwargs)()
    number, room = int(d.nacon.numpy()[0]), lists.found.numpy()
    contact = SimpleNamespace(
        **{name: getattr(d.contact, name).numpy()[:number] for name in FIELDS}
    )
    mj_data, met = mujoco.MjData(world.mj_model), set()
    for row, qpos in enumerate(world.qpos_EL.double().cpu().numpy()):
        mj_data.qpos[:] = qpos
        mujoco.mj_kinematics(world.mj_model, mj_data)
        mujoco.mj_collision(world.mj_model, mj_data)
        listed = np.sort(room[row, : lists.appended.numpy()[row]])
        assert (listed == np.flatnonzero(d.contact.worldid.numpy()[:number] == row)).all()
        own, theirs = contacts_of(contact, listed), contacts_of(mj_data.contact, slice(None))
        assert own.shape == theirs.shape, row
        np.testing.assert_allclose(own, theirs, atol=1e-4, err_msg=str(row))
        met |= {
            tuple(kinds) for kinds in world.mj_model.geom_type[theirs[:, -2:].astype(int)].tolist()
        }
    kind = {
        name.removeprefix("mjGEOM_").lower(): int(kind)
        for name, kind in mujoco.mjtGeom.__members__.items()
    }
    assert met == {(kind[a], kind[b]) for a, others in MOST_CONTACTS.items() for b in others}


def test_contacts_of_known_types_are_those_of_the_c_engine():
    check_against_c()


def test_more_contacts_than_there_is_room_for_are_counted():
    world = known()
    m, d = world.warp_model, world.warp_data_E
    with wp.ScopedDevice("cpu"):
        mjw.collision(m, d)
        number, lists = int(d.nacon.numpy()[0]), ContactLists(m, d)
        d.naconmax = number // 2
        d.nacon.zero_()
        collisions(m, d, lists)()
    assert int(d.nacon.numpy()[0]) > d.naconmax == lists.appended.numpy().sum()


def test_pairs_of_other_types_are_left_to_mujoco_warp():
    left = str(pairs_left(pile().warp_model))
    assert left.startswith("box and box, ") and left.endswith(
        "meet, whose contacts they alone find"
    )
    assert (
        "ellipsoid and box" in left
        and "sphere and box" not in left
        and "capsule and box" not in left
    )


def test_a_model_outside_of_it_keeps_mujoco_warps():
    world = pile()
    world.warp_model.opt.broadphase = mjw.BroadphaseType.SAP_TILE
    assert "sweeps" in str(broad_phase_unavailable(world.warp_model, world.warp_data_E))
