"""Contacts that MuJoCo Warp alone would find differently agree with the C engine."""

import warnings

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.physics.warp_world import WarpWorld
from tests.physics.beside_c import ALL_KERNELS, KERNELS, step_and_check

NUM_ENVS = 64
# The plane is the last geom: contacts order geoms by their type, pairs by their number.
THINGS = """
<mujoco>
  <default><default class="high"><geom type="box" contype="2" conaffinity="2"/></default></default>
  <worldbody>
    <body pos="0 0 3"><freejoint/><geom class="high" size="0.1 0.07 0.05"/></body>
    <body pos="0 0 3"><freejoint/><geom class="high" size="0.06 0.1 0.04"/></body>
    <body pos="2 0 1"><freejoint/><geom type="capsule" size="0.03 0.1"/></body>
    <body><geom type="plane" size="5 5 1" {turned}/></body>
  </worldbody>
</mujoco>
"""


def touching(mj_model: mujoco.MjModel, seed: int) -> torch.Tensor:
    """Draw poses, float32 [E, 21]: a box up to 1 cm deep in another one from any side, a rod in the floor, tilted."""
    rng, mj_data = np.random.default_rng(seed), mujoco.MjData(mj_model)
    poses = np.tile(mj_model.qpos0, (NUM_ENVS, 1))
    for qpos in poses:
        for body in range(3):
            quat = rng.normal(size=4) * ([1.0, 1.0, 1.0, 1.0] if body < 2 else [1.0, 0.2, 0.2, 1.0])
            qpos[7 * body + 3 : 7 * body + 7] = quat / np.linalg.norm(quat)
        towards = rng.normal(size=3)
        ways = (
            (7, {0, 1}, towards / np.linalg.norm(towards), 0.0),
            (14, {2, 3}, np.array([0.0, 0.0, 1.0]), -2.0),
        )
        for place, pair, direction, low in ways:
            start, high = qpos[place : place + 3].copy(), 0.5
            for _ in range(25):
                qpos[place : place + 3] = start + 0.5 * (low + high) * direction
                mj_data.qpos[:] = qpos
                mujoco.mj_fwdPosition(mj_model, mj_data)
                meets = any(set(contact.geom) == pair for contact in mj_data.contact)
                low, high = (0.5 * (low + high), high) if meets else (low, 0.5 * (low + high))
            qpos[place : place + 3] = start + (low - rng.uniform(0.0, 0.01)) * direction
    return torch.tensor(poses, dtype=torch.float32)


@pytest.mark.parametrize("turned", ["", 'euler="20 10 0"'])
def test_boxes_and_steep_rods_touch_as_in_the_c_engine(turned):
    check_contacts(turned)


def check_contacts(turned: str, device: str = "cpu") -> None:
    """Compare all contacts of a step with the C engine's from the same poses."""
    mj_model = load_model(THINGS.format(turned=turned))
    pose_EL = touching(mj_model, seed=0)
    world = World(mj_model, num_envs=NUM_ENVS, device=device, sim=SimCfg(njmax=120, nconmax=24))
    world.qpos_EL.copy_(pose_EL)
    world.step()
    contact, count = world.warp_data_E.contact, int(world.warp_data_E.nacon.numpy()[0])
    fields = ("worldid", "geom", "dist", "pos", "frame")
    owner, geom, dist, pos, frame = (getattr(contact, name).numpy()[:count] for name in fields)
    mj_data, several, steep = mujoco.MjData(mj_model), 0, 0
    for row, qpos in enumerate(pose_EL.double().numpy()):
        mj_data.qpos[:] = qpos
        mujoco.mj_fwdPosition(mj_model, mj_data)
        for pair in ({0, 1}, {2, 3}):
            theirs = [each for each in mj_data.contact if set(each.geom) == pair]
            mine = [i for i in np.flatnonzero(owner == row) if set(geom[i]) == pair]
            assert len(mine) == len(theirs) > 0, (row, pair)
            for each in theirs:
                nearest = min(mine, key=lambda i: np.linalg.norm(pos[i] - each.pos))
                assert np.allclose(pos[nearest], each.pos, atol=1e-5), (row, pair)
                assert dist[nearest] == pytest.approx(each.dist, abs=1e-5), (row, pair)
                assert np.allclose(frame[nearest].ravel(), each.frame, atol=1e-4), (row, pair)
            several += pair == {0, 1} and len(theirs) > 1
            axis = mj_data.geom_xmat[2].reshape(3, 3)[:, 2]
            steep += pair == {2, 3} and np.linalg.norm(np.cross(axis, theirs[0].frame[:3])) < 0.5
    assert several >= 5 and steep >= 5


@pytest.mark.parametrize("one_kernel", [True, False])
def test_an_upright_rod_has_the_frame_of_the_c_engine(one_kernel: bool):
    mj_model = load_model(THINGS.format(turned=""))
    sim = SimCfg(njmax=120, nconmax=24, one_kernel_dynamics=one_kernel)
    world = World(mj_model, num_envs=1, sim=sim)
    world.qpos_EL[0, 16] = 0.12
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[:] = world.qpos_EL[0].double().numpy()
    mujoco.mj_forward(mj_model, mj_data)
    world.step()
    expected = mj_data.contact.frame[(np.array(mj_data.contact.geom) == [3, 2]).all(-1)]
    count = int(world.last_substep("nacon").item())
    geoms, frames = (
        world.last_substep("contact.geom")[:count],
        world.last_substep("contact.frame")[:count],
    )
    found = frames[(geoms == torch.tensor([3, 2])).all(-1)].reshape(-1, 9).double()
    torch.testing.assert_close(found, torch.from_numpy(expected))
    assert len(expected) == 1


@pytest.mark.parametrize("kernels", ALL_KERNELS)
@pytest.mark.parametrize("cone", ("pyramidal", "elliptic"))
def test_a_belt_carries_a_steep_rod_as_in_the_c_engine(cone: str, kernels: str):
    xml = f"""
<mujoco>
  <option cone="{cone}"/>
  <worldbody>
    <geom type="plane" size="5 5 1" surfacevel="0.5 -0.3 0 0 0 1"/>
    <body pos="0 0 0.195" euler="10 5 0"><freejoint/>
      <geom type="capsule" size="0.1 0.1" mass="1" condim="4" surfacevel="0.2 0 0.1 0 0.3 0"/></body>
  </worldbody>
</mujoco>
"""
    step_and_check(xml, KERNELS[kernels], spread=0.002, speed=0.1)


def test_a_moving_field_carries_balls_at_any_depth_as_in_the_c_engine():
    """Fields of models with moving surfaces were left to MuJoCo Warp, whose depths are off by centimetres."""
    xml = """
<mujoco>
  <asset>
    <hfield name="hills" nrow="3" ncol="3" size="1 1 0.1 0.1" elevation="0.9 0.6 0.1 0.5 1 0.2 0.4 0.1 0.3"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="hills" surfacevel="0.5 -0.3 0 0 0 1"/>
    <body pos="0.28 0.25 -0.02">
      <joint type="slide" axis="1 1 0"/><joint type="slide" axis="1 -1 0"/><geom size="0.08"/></body>
    <body pos="-0.4 0.5 0.15"><freejoint/><geom size="0.08" condim="4"/></body>
    <body pos="-0.6 -0.4 0.18"><freejoint/><geom type="box" size="0.1 0.1 0.1" margin="1e-6"/></body>
  </worldbody>
</mujoco>
"""
    step_and_check(xml, KERNELS["our solver"], spread=0.002, speed=0.1)


# Of each pair one geom has priority, and one gives stiffness and damping directly; the last pair has a law of its own.
LAWS = """
<mujoco>
  <asset><mesh name="wedge" vertex="-.1 -.1 -.1 .1 -.1 -.1 0 .1 -.1 0 0 .1"/></asset>
  <asset><hfield name="ground" nrow="3" ncol="3" size="1 1 0.1 0.1" elevation="0 0 0 0 0 0 0 0 0"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" priority="1" solref="-500 -10" solimp="0.8 0.9 0.01"/>
    <geom name="table" type="box" size="0.2 0.2 0.1" pos="3 0 0.5" priority="2" solref="0.01 1"/>
    <geom name="hills" type="hfield" hfield="ground" pos="-3 0 1" priority="1" solref="-300 -5"/>
    <body pos="0 0 0.09"><freejoint/><geom name="egg" type="ellipsoid" size="0.1 0.12 0.1"/></body>
    <body pos="1 0 0.09"><freejoint/><geom name="wedge" type="mesh" mesh="wedge" priority="3" condim="4"/></body>
    <body pos="2 0 0.09"><freejoint/><geom name="ball" size="0.1" solref="-900 -9" priority="1"/></body>
    <body pos="3 0 0.69"><freejoint/><geom name="box" type="box" size="0.1 0.1 0.1" solref="-800 -8"/></body>
    <body pos="-3 0.1 1.09"><freejoint/><geom name="marble" size="0.1" solref="0.03 0.5"/></body>
    <body pos="0 3 0.09"><freejoint/><geom name="can" type="cylinder" size="0.1 0.1" priority="2"/></body>
  </worldbody>
  <contact><pair geom1="floor" geom2="can" solref="0.04 0.7"/></contact>
</mujoco>
"""
LAW = ("solref", "solimp", "friction", "dim")


@pytest.mark.parametrize("one_kernel", [pytest.param(True, marks=pytest.mark.full), False])
def test_the_geom_of_priority_alone_says_how_stiff_a_contact_is(one_kernel: bool):
    mj_model = load_model(LAWS)
    sim = SimCfg(njmax=200, nconmax=60, one_kernel_dynamics=one_kernel)
    world = World(mj_model, num_envs=2, sim=sim, per_world_fields=["geom_solref"])
    # In the second world the table, too, gives its stiffness directly.
    world.field("geom_solref")[1, mj_model.geom("table").id] = torch.tensor([-700.0, -7.0])
    world.step()
    contact, count = world.warp_data_E.contact, int(world.warp_data_E.nacon.numpy()[0])
    owner, geom = contact.worldid.numpy()[:count], np.sort(contact.geom.numpy()[:count], axis=1)
    for row in range(2):
        mj_model.geom_solref[mj_model.geom("table").id] = ([0.01, 1.0], [-700.0, -7.0])[row]
        mj_data = mujoco.MjData(mj_model)
        mujoco.mj_forward(mj_model, mj_data)
        pairs = {(int(each.geom1), int(each.geom2)): each for each in mj_data.contact}
        assert len(pairs) == 6
        for pair, each in pairs.items():
            mine = np.flatnonzero((owner == row) & (geom == np.sort(pair)).all(-1))
            assert mine.size, pair
            for name in LAW:
                for value in getattr(contact, name).numpy()[mine]:
                    np.testing.assert_allclose(
                        value, getattr(each, name), rtol=1e-5, err_msg=f"{pair} {name}"
                    )


# Several pairs of the same geoms, of which one has a margin in which a box's upper corners are; pairs that no joint can
# heed, of one body, of a body without joints and of things that never move; and geoms that touch without a pair.
PAIRS = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <geom name="stone" size="0.1" pos="1 0 0.02"/><geom name="rock" size="0.2" pos="1 0.2 0"/>
    <body name="thing" pos="0 0 0.09"><freejoint/>
      <geom name="ball" size="0.1"/><geom name="box" type="box" size="0.1 0.1 0.1" pos="0.33 0 0"/>
      <body><geom name="knob" size="0.1" pos="0.1 0 0"/></body>
    </body>
    <body name="shelf"><geom name="shelf" type="box" size="0.1 0.1 0.1" pos="2 0 0"/></body>
    <body name="hand" mocap="true" pos="0 1 0.05"><geom name="hand" size="0.1"/></body>
  </worldbody>
  <contact>
    <pair geom1="floor" geom2="ball" condim="1"/>
    <pair geom1="floor" geom2="box" condim="1"/>
    <pair geom1="floor" geom2="ball" condim="4" friction="2 2 1 1 1"/>
    <pair geom1="floor" geom2="box" condim="3" margin="0.3"/>
    <pair geom1="ball" geom2="floor" condim="3"/>
    <pair geom1="rock" geom2="stone" condim="4"/>
    <pair geom1="ball" geom2="knob"/>
    <pair geom1="floor" geom2="shelf"/>
    <pair geom1="floor" geom2="hand"/>
  </contact>
  <sensor><contact subtree1="thing" data="found force"/><contact geom1="shelf" data="found force"/></sensor>
</mujoco>
"""


@pytest.mark.parametrize("one_kernel", [True, False])
def test_all_pairs_make_contacts_and_rows_where_joints_can_heed_them(one_kernel: bool):
    mj_model = load_model(PAIRS)
    world = World(
        mj_model, num_envs=2, sim=SimCfg(njmax=80, nconmax=60, one_kernel_dynamics=one_kernel)
    )
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    assert [each.dim for each in mj_data.contact if set(each.geom) == {0, 3}] == [1, 4, 3]
    world.step()
    contact, count = world.warp_data_E.contact, int(world.warp_data_E.nacon.numpy()[0])
    owner, geom, dim, dist, rows = (
        getattr(contact, name).numpy()[:count]
        for name in ("worldid", "geom", "dim", "dist", "efc_address")
    )
    for row in range(2):
        mine = np.flatnonzero((owner == row) & (contact.type.numpy()[:count] != 0))
        found = sorted(
            (*geom[i].tolist(), int(dim[i]), round(float(dist[i]), 4), rows[i, 0] >= 0)
            for i in mine
        )
        expected = [
            (*each.geom.tolist(), each.dim, round(each.dist, 4), each.efc_address >= 0)
            for each in mj_data.contact
        ]
        assert found == sorted(expected)
        assert int(world.warp_data_E.nefc.numpy()[row]) == mj_data.nefc
        if one_kernel:
            in_order = sorted(
                (int(rows[i, 0]), *geom[i].tolist(), int(dim[i])) for i in mine if rows[i, 0] >= 0
            )
            assert in_order == [
                (each.efc_address, *each.geom.tolist(), each.dim)
                for each in mj_data.contact
                if each.efc_address >= 0
            ]
        np.testing.assert_allclose(
            world.last_substep("qacc")[row], mj_data.qacc, rtol=1e-3, atol=1e-3
        )
        np.testing.assert_allclose(
            world.sensordata_EL[row], mj_data.sensordata, rtol=1e-3, atol=1e-2
        )


BEAM = (
    '<mujoco><worldbody><geom name="ground" type="plane" size="1 1 1"/><body pos="0 0 1">{joint}'
    '<geom name="beam" type="capsule" size="0.05 0.1" euler="0 90 0" pos="{off} 0 0"/></body></worldbody></mujoco>'
)
HINGE = '<joint axis="0 1 0"/>'


BALL = '<body pos="0 0 2"><freejoint/><geom name="ball" size="0.1" conaffinity="2"/></body>'
# A ball may touch the beam, and the ground may not.
APART = BEAM.replace('name="ground"', 'name="ground" contype="0" conaffinity="2"').replace(
    "</worldbody>", BALL + "</worldbody>"
)


@pytest.mark.parametrize(
    ("xml", "joint", "off", "warns"),
    (
        (BEAM, HINGE, 0.0, True),
        (BEAM, HINGE, 0.02, False),
        (BEAM, "<freejoint/>", 0.0, False),
        (APART, HINGE, 0.0, False),
        (
            BEAM.replace("<worldbody>", '<option><flag contact="disable"/></option><worldbody>'),
            HINGE,
            0.0,
            False,
        ),
    ),
)
def test_what_turns_about_its_centre_of_mass_and_may_touch_the_ground_is_warned_of(
    xml: str, joint: str, off: float, warns: bool
) -> None:
    mj_model = load_model(xml.format(joint=joint, off=off))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        world = WarpWorld(mj_model, num_envs=1, sim=SimCfg(engine="warp"))
    told = [str(warning.message) for warning in caught if "no weight" in str(warning.message)]
    assert len(told) == warns
    assert all("geom 'ground' and geom 'beam' may touch" in text for text in told)
    # Bodies without a warning have C's weights to the last bit.
    weights = world.warp_model.body_invweight0.numpy()[0]
    assert (weights != mj_model.body_invweight0.astype(np.float32)).any() == warns
