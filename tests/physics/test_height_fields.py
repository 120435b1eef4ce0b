"""Contacts with height fields are the C engine's, or those with a plane where the ground is one."""

import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model

NUM_ENVS = 48
SIDE, CELLS, TOP = 2.0, 13, 0.3
"""Half an edge of the field, m; its cells along an edge; its highest point, m."""
THINGS = """
<mujoco>
  <option timestep="0.002"/>
  <default>
    <geom mass="1" contype="1" conaffinity="2"/>
  </default>
  <worldbody>
    <body name="ball"><freejoint/>
      <geom name="ball" type="sphere" size="0.05" condim="6" friction="0.7 0.01 0.002" priority="1" solref="0.01 0.9"/>
    </body>
    <body name="rod"><freejoint/>
      <geom name="rod" type="capsule" size="0.03 0.15" condim="1" solmix="3" solimp="0.8 0.9 0.002"/>
    </body>
    <body name="box"><freejoint/><geom name="box" type="box" size="0.2 0.15 0.1"/></body>
    <body name="can"><freejoint/><geom name="can" type="cylinder" size="0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""
BODIES = ("ball", "rod", "box", "can")


def model(heights: np.ndarray, *, top=TOP, pairs=()) -> mujoco.MjModel:
    """Return the things and a field of heights in [0, 1], or with `top=None` a level plane."""
    spec = mujoco.MjSpec.from_string(THINGS)
    shape = {"name": "ground", "contype": 2, "conaffinity": 1, "friction": [0.9, 0.02, 0.001]}
    rows, columns = heights.shape
    size = [SIDE, SIDE, top, 0.5]
    spec.add_hfield(name="field", size=size, nrow=rows, ncol=columns, userdata=heights.ravel().tolist())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field", **shape)
    for geom in pairs:
        spec.add_pair(geomname1="ground", geomname2=geom, friction=[0.3, 0.3, 0.1, 0.1, 0.1], condim=4)
    return load_model(spec)


def noise() -> np.ndarray:
    heights = np.random.default_rng(0).uniform(size=(CELLS + 1, CELLS + 1))
    return (heights - heights.min()) / np.ptp(heights)


def tilted() -> np.ndarray:
    """Heights of a plane that rises from 0 to 1 along x."""
    return np.tile(np.linspace(0.0, 1.0, CELLS + 1), (CELLS + 1, 1))


def poses(seed=0) -> torch.Tensor:
    """Draw poses of all bodies over the field, some upright and some not, high above it, [E, 28]."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(-1.5, 1.5, size=(NUM_ENVS, 4, 2))
    quat = rng.normal(size=(NUM_ENVS, 4, 4)) * [1.0, 0.3, 0.3, 1.0]
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    pose = np.concatenate((place, np.full((NUM_ENVS, 4, 1), 2.0), quat), axis=-1)
    return torch.tensor(pose.reshape(NUM_ENVS, 28), dtype=torch.float32)


def lowered(mj_model: mujoco.MjModel, pose_EL: torch.Tensor, body: str, depth: float) -> torch.Tensor:
    """Lower one body in each row until it is `depth` (m) below the height at which the C engine sees it touch."""
    mj_data, number = mujoco.MjData(mj_model), BODIES.index(body)
    column, geom = 7 * number + 2, mj_model.geom(body).id
    lowered_EL = pose_EL.clone()
    for row in lowered_EL:
        low, high = 0.0, 2.0
        for _ in range(24):
            middle = (low + high) / 2
            mj_data.qpos[:] = row.numpy()
            mj_data.qpos[column] = middle
            mujoco.mj_kinematics(mj_model, mj_data)
            mujoco.mj_comPos(mj_model, mj_data)
            mujoco.mj_collision(mj_model, mj_data)
            low, high = (middle, high) if any(geom in c.geom for c in mj_data.contact) else (low, middle)
        row[column] = low - depth
    return lowered_EL


class Contacts:
    """The contacts that the last Warp step found, by world and geom; the first one starts from poses [E, 28]."""

    def __init__(self, mj_model: mujoco.MjModel, pose_EL: torch.Tensor, device="cpu") -> None:
        self.mj_model = mj_model
        self.world = World(mj_model, num_envs=len(pose_EL), device=device, sim=SimCfg(njmax=120, nconmax=40))
        self.find(pose_EL)

    def find(self, pose_EL: torch.Tensor) -> None:
        """Step once from poses, at rest, and read the contacts."""
        world = self.world
        world.qpos_EL.copy_(pose_EL)
        world.qvel_EL.zero_()
        world.refresh()
        world.step()
        contact, count = world.warp_data_E.contact, int(world.warp_data_E.nacon.numpy()[0])
        self.fields = {
            name: getattr(contact, name).numpy()[:count]
            for name in (
                "worldid",
                "geom",
                "dist",
                "pos",
                "frame",
                "dim",
                "friction",
                "solref",
                "solimp",
                "includemargin",
            )
        }

    def of(self, row: int, geom: str) -> dict[str, np.ndarray]:
        """Return the contacts of a geom in a world, deepest first."""
        fields = self.fields
        chosen = np.flatnonzero(
            (fields["worldid"] == row) & (fields["geom"] == self.mj_model.geom(geom).id).any(-1)
        )
        chosen = chosen[np.argsort(fields["dist"][chosen])]
        return {name: values[chosen] for name, values in fields.items()}


def of_the_c_engine(mj_model: mujoco.MjModel, pose_L: torch.Tensor, geom: str) -> list[mujoco.MjContact]:
    """Return the contacts of a geom in the C engine, deepest first."""
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[:] = pose_L.numpy()
    mujoco.mj_forward(mj_model, mj_data)
    number = mj_model.geom(geom).id
    found = [mj_data.contact[i] for i in range(mj_data.ncon) if number in mj_data.contact[i].geom]
    return sorted(found, key=lambda c: c.dist)


@pytest.mark.parametrize("body", ["ball", "rod"])
@pytest.mark.parametrize("depth", [0.0005, 0.01])
def test_the_deepest_contact_on_rough_ground_is_that_of_the_c_engine(body, depth):
    mj_model = model(noise())
    pose_EL = lowered(mj_model, poses(), body, depth)
    check_deepest(Contacts(mj_model, pose_EL), pose_EL, body)


def check_deepest(ours: Contacts, pose_EL: torch.Tensor, body: str) -> None:
    """Compare the deepest contact of a body in each world with the C engine's."""
    for row in range(NUM_ENVS):
        mine, theirs = ours.of(row, body), of_the_c_engine(ours.mj_model, pose_EL[row], body)[0]
        assert mine["dist"][0] == pytest.approx(theirs.dist, abs=2e-5), row
        assert np.allclose(mine["frame"][0, 0], theirs.frame[:3], atol=2e-3), row
        if body == "ball":  # a rod that lies on the ground touches it in more than one place equally
            assert np.allclose(mine["pos"][0], theirs.pos, atol=1e-4), row
        for name in ("dim", "friction", "solref", "solimp", "includemargin"):
            assert np.allclose(mine[name][0], getattr(theirs, name), atol=1e-6), name


def test_what_does_not_touch_in_the_c_engine_does_not_touch():
    mj_model = model(noise())
    pose_EL = poses()
    for body in ("ball", "rod"):
        pose_EL = lowered(mj_model, pose_EL, body, -1e-3)
    ours = Contacts(mj_model, pose_EL)
    assert all(ours.of(row, body)["dist"].size == 0 for row in range(NUM_ENVS) for body in BODIES)


@pytest.mark.parametrize("body", ["ball", "rod", "box"])
def test_on_an_even_slope_contacts_are_those_with_a_plane(body):
    """A box or rod has as many as corners or ends below it; MuJoCo's plane leaves none of these few out."""
    mj_model = model(tilted())
    pose_EL = lowered(mj_model, poses(1), body, 0.004)
    check_on_slope(Contacts(mj_model, pose_EL), pose_EL, body)


def check_on_slope(ours: Contacts, pose_EL: torch.Tensor, body: str) -> None:
    """Compare the contacts of a body on the ground of `tilted` with those of its points below that plane."""
    angle = math.atan2(TOP, 2 * SIDE)
    normal = np.array([-math.sin(angle), 0.0, math.cos(angle)])
    compared = 0
    for row in range(NUM_ENVS):
        number = BODIES.index(body)
        pos, quat = (
            pose_EL[row, 7 * number : 7 * number + 3].double().numpy(),
            pose_EL[row, 7 * number + 3 :][:4],
        )
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, quat.double().numpy())
        points = {
            "ball": np.zeros((1, 3)),
            "rod": np.array([[0, 0, 0.15], [0, 0, -0.15]]),
            "box": np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.15, 0.15) for z in (-0.1, 0.1)]),
        }[body]
        radius = {"ball": 0.05, "rod": 0.03, "box": 0.0}[body]
        above = (points @ turn.reshape(3, 3).T + pos - [-SIDE, 0, 0]) @ normal - radius
        below = np.sort(above[above < -1e-5])
        mine = ours.of(row, body)
        assert np.allclose(mine["dist"][mine["dist"] < -1e-5], below[:4], atol=1e-5), row
        assert np.allclose(mine["frame"][:, 0], normal, atol=1e-4), row
        compared += below.size
    assert compared >= NUM_ENVS


def test_an_edge_of_the_ground_presses_into_faces_and_between_the_ends_of_rods():
    """A ridge along y, lower than what lies across it: contact at the ridge, straight up, as deep as it stands out."""
    heights = np.zeros((CELLS + 2, CELLS + 2))
    heights[:, (CELLS + 1) // 2] = 1.0
    mj_model = model(heights, top=0.05)
    pose_EL = poses()[:1]
    x = mj_model.hfield_size[0, 0] * (2 * ((CELLS + 1) // 2) / (CELLS + 1) - 1)
    flat, lying = [1.0, 0.0, 0.0, 0.0], [math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0]
    pose_EL[0, 7:14] = torch.tensor([x + 0.02, 0.5, 0.05 + 0.03 - 0.002, *lying])
    pose_EL[0, 14:21] = torch.tensor([x + 0.02, -0.5, 0.05 + 0.1 - 0.003, *flat])
    ours = Contacts(mj_model, pose_EL)
    for body, depth in (("rod", 0.002), ("box", 0.003)):
        mine = ours.of(0, body)
        assert mine["dist"].size and np.allclose(mine["dist"], -depth, atol=1e-5), body
        assert np.allclose(mine["pos"][:, 0], x, atol=1e-5) and np.allclose(
            mine["frame"][:, 0], [0, 0, 1], atol=1e-5
        )
        if body == "rod":
            assert mine["dist"][0] == pytest.approx(
                of_the_c_engine(mj_model, pose_EL[0], body)[0].dist, abs=1e-5
            )


@pytest.mark.parametrize(("roll", "touching"), [(0.0, (-0.15, 0.15)), (0.2, (-0.15,)), (-0.2, (0.15,))])
@pytest.mark.parametrize("turned", [False, True])
def test_edges_of_a_box_touch_a_ridge_between_points_of_the_lattice(roll, touching, turned):
    """A ridge with one point per metre: edges that cross it touch it, both where the box lies flat, else one."""
    heights = np.zeros((5, 5))
    heights[2 if turned else slice(None), slice(None) if turned else 2] = 1.0
    mj_model = model(heights, top=0.5)
    pose_EL = poses()[:1]
    # The lower edges are at +-0.15 along the ridge, 0.1 below the middle.
    half_turn = [math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0]
    if turned:
        quat = np.zeros(4)
        mujoco.mju_mulQuat(quat, np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]), np.array(half_turn))
        half_turn = quat.tolist()
    lowest = 0.15 * abs(math.sin(roll)) + 0.1 * math.cos(roll)
    along = 0.5
    place = [-along, 0.03] if turned else [0.03, along]
    pose_EL[0, 14:21] = torch.tensor([*place, 0.5 + lowest - 0.004, *half_turn])
    mine = Contacts(mj_model, pose_EL).of(0, "box")
    assert len(mine["dist"]) == len(touching)
    assert np.allclose(mine["dist"], -0.004, atol=1e-5) and np.allclose(
        mine["frame"][:, 0], [0, 0, 1], atol=1e-4
    )
    assert np.allclose(mine["pos"][:, 1 if turned else 0], 0.0, atol=1e-5)
    found = np.sort(mine["pos"][:, 0 if turned else 1])
    expected = [y * math.cos(roll) + 0.1 * math.sin(roll) for y in touching]
    expected = [-along - y for y in expected] if turned else [along + y for y in expected]
    assert np.allclose(found, np.sort(expected), atol=1e-4)


def test_a_ball_in_a_corner_touches_floor_and_wall():
    heights = np.zeros((41, 41))
    heights[:, 21:] = 1.0
    mj_model = model(heights, top=0.4)
    pose_EL = poses()[:1]
    wall = math.atan2(0.4, 0.1)
    touching = (0.05 * (1 - math.cos(wall))) / math.sin(wall)
    pose_EL[0, :7] = torch.tensor([0.0 - touching + 0.001, 0.0, 0.05 - 0.001, 1.0, 0.0, 0.0, 0.0])
    mine = Contacts(mj_model, pose_EL).of(0, "ball")
    normals = mine["frame"][:, 0][np.argsort(mine["frame"][:, 0, 2])]
    assert np.allclose(normals, [[-math.sin(wall), 0.0, math.cos(wall)], [0.0, 0.0, 1.0]], atol=1e-4)


def test_nothing_tunnels_however_deep_it_got():
    mj_model = model(noise())
    pose_EL = lowered(mj_model, poses(), "ball", 0.4)
    mine = Contacts(mj_model, pose_EL)
    for row in range(NUM_ENVS):
        contact = mine.of(row, "ball")
        assert contact["dist"][0] < -0.1 and contact["frame"][0, 0, 2] > 0.0


def test_a_pair_of_the_model_keeps_its_own_parameters():
    mj_model = model(noise(), pairs=("rod",))
    pose_EL = lowered(mj_model, poses(), "rod", 0.002)[:4]
    ours = Contacts(mj_model, pose_EL)
    for row in range(4):
        mine, theirs = ours.of(row, "rod"), of_the_c_engine(mj_model, pose_EL[row], "rod")[0]
        assert mine["dim"][0] == theirs.dim == 4 and np.allclose(mine["friction"][0], theirs.friction)


def test_other_shapes_stay_with_mujoco_warp():
    mj_model = model(np.tile([[0.0, 1.0]], (2, 1)), top=1e-3)
    pose_EL = poses()
    pose_EL[:, 21:28] = torch.tensor([0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0])
    assert Contacts(mj_model, pose_EL[:1]).of(0, "can")["dist"].size > 0
