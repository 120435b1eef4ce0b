"""Contacts with height fields are the C engine's."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model

NUM_ENVS = 48
SIDE, CELLS, TOP = 2.0, 13, 0.3
"""Half an edge of the field, m; its cells along an edge; its highest point, m."""
# Without a margin C's contacts of boxes with height fields are less deep than they are (docs/upstream.md).
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
    <body name="box"><freejoint/><geom name="box" type="box" size="0.2 0.15 0.1" margin="1e-6"/></body>
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
    spec.add_hfield(
        name="field", size=size, nrow=rows, ncol=columns, userdata=heights.ravel().tolist()
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field", **shape)
    for geom in pairs:
        spec.add_pair(
            geomname1="ground", geomname2=geom, friction=[0.3, 0.3, 0.1, 0.1, 0.1], condim=4
        )
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


def lowered(
    mj_model: mujoco.MjModel, pose_EL: torch.Tensor, body: str, depth: float
) -> torch.Tensor:
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
            low, high = (
                (middle, high) if any(geom in c.geom for c in mj_data.contact) else (low, middle)
            )
        row[column] = low - depth
    return lowered_EL


class Contacts:
    """The contacts that the last Warp step found, by world and geom; the first one starts from poses [E, 28]."""

    def __init__(self, mj_model: mujoco.MjModel, pose_EL: torch.Tensor, device="cpu") -> None:
        self.mj_model = mj_model
        self.world = World(
            mj_model, num_envs=len(pose_EL), device=device, sim=SimCfg(njmax=120, nconmax=40)
        )
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


def of_the_c_engine(
    mj_model: mujoco.MjModel, pose_L: torch.Tensor, geom: str
) -> list[mujoco.MjContact]:
    """Return the contacts of a geom in the C engine, deepest first."""
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[:] = pose_L.numpy()
    mujoco.mj_forward(mj_model, mj_data)
    number = mj_model.geom(geom).id
    found = [mj_data.contact[i] for i in range(mj_data.ncon) if number in mj_data.contact[i].geom]
    return sorted(found, key=lambda c: c.dist)


def cliffs() -> np.ndarray:
    """Heights of a floor with steps, whose walls are as wide as a cell."""
    return np.round(2.0 * noise()) / 2.0


@pytest.mark.parametrize("body", ["ball", "rod", "box"])
@pytest.mark.parametrize("depth", [0.0005, 0.01])
def test_contacts_on_rough_ground_are_those_of_the_c_engine(body, depth):
    mj_model = model(noise())
    pose_EL = lowered(mj_model, poses(), body, depth)
    check_contacts(Contacts(mj_model, pose_EL), pose_EL, body)


@pytest.mark.parametrize("body", ["ball", "rod", "box"])
def test_contacts_in_corners_and_on_ridges_are_those_of_the_c_engine(body):
    mj_model = model(cliffs())
    pose_EL = lowered(mj_model, poses(1), body, 0.004)
    check_contacts(Contacts(mj_model, pose_EL), pose_EL, body)


@pytest.mark.parametrize("body", ["ball", "rod", "box"])
def test_what_is_deep_in_the_ground_or_at_its_rim_touches_as_in_the_c_engine(body):
    mj_model, first = model(noise()), 7 * BODIES.index(body)
    pose_EL = lowered(mj_model, poses(), body, 0.15)
    # A half of them hang over the rim, or are beside it.
    pose_EL[::2, first] = SIDE + torch.linspace(-0.2, 0.06, NUM_ENVS // 2)
    check_contacts(Contacts(mj_model, pose_EL), pose_EL, body)


def check_contacts(ours: Contacts, pose_EL: torch.Tensor, body: str) -> None:
    """Compare all contacts of a body in each world with the C engine's."""
    several = 0
    for row in range(NUM_ENVS):
        mine, theirs = ours.of(row, body), of_the_c_engine(ours.mj_model, pose_EL[row], body)
        assert len(mine["dist"]) == len(theirs), row
        several += len(theirs) > 1
        used: set[int] = set()
        for each in theirs:
            # Where edges or faces are parallel, any place of theirs is as close.
            away = np.linalg.norm(mine["pos"] - each.pos, axis=1) + 10.0 * np.abs(
                mine["dist"] - each.dist
            )
            away[list(used)] = np.inf
            nearest = int(away.argmin())
            used.add(nearest)
            assert mine["dist"][nearest] == pytest.approx(each.dist, abs=2e-5), row
            assert np.allclose(mine["frame"][nearest, 0], each.frame[:3], atol=2e-3), row
            assert np.allclose(mine["pos"][nearest], each.pos, atol=5e-4), row
            for name in ("dim", "friction", "solref", "solimp", "includemargin"):
                assert np.allclose(mine[name][nearest], getattr(each, name), atol=1e-6), name
    assert several > 0


def test_what_does_not_touch_in_the_c_engine_does_not_touch():
    mj_model = model(noise())
    pose_EL = poses()
    for body in ("ball", "rod"):
        pose_EL = lowered(mj_model, pose_EL, body, -1e-3)
    ours = Contacts(mj_model, pose_EL)
    assert all(ours.of(row, body)["dist"].size == 0 for row in range(NUM_ENVS) for body in BODIES)


def test_a_box_that_lies_flat_has_a_contact_for_each_prism_below_it():
    """Which place of a prism it touches is another matter: all are as deep."""
    mj_model = model(np.zeros((CELLS + 1, CELLS + 1)))
    pose_EL = poses()
    pose_EL[:, 14 + 2] = 0.1 - 0.003
    pose_EL[:, 14 + 4 : 14 + 6] = 0.0
    pose_EL[:, 14 + 3 : 14 + 7] /= pose_EL[:, 14 + 3 : 14 + 7].norm(dim=1, keepdim=True)
    ours = Contacts(mj_model, pose_EL)
    for row in range(NUM_ENVS):
        mine, theirs = ours.of(row, "box"), of_the_c_engine(mj_model, pose_EL[row], "box")
        assert len(mine["dist"]) == len(theirs) > 1
        assert np.allclose(mine["dist"], [each.dist for each in theirs], atol=1e-5)
        # Along the rim of the footprint, where a side of a prism is nearer than its top, the way out is sideways.
        assert (mine["frame"][:, 0, 2] > 0.99).sum() == sum(each.frame[2] > 0.99 for each in theirs)


def test_more_contacts_than_a_pair_may_have_are_left_out_as_in_the_c_engine_and_told():
    spec = mujoco.MjSpec()
    heights = np.random.default_rng(0).uniform(size=(24, 24))
    spec.add_hfield(
        name="field", size=[1, 1, 0.2, 0.5], nrow=24, ncol=24, userdata=heights.ravel().tolist()
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field")
    body = spec.worldbody.add_body(pos=[0, 0, 0.4])
    body.add_freejoint()
    body.add_geom(size=[0.4, 0, 0])
    mj_model = load_model(spec)
    world = World(mj_model, num_envs=1, sim=SimCfg(njmax=400, nconmax=100))
    world.step()
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    assert int(world.warp_data_E.nacon.numpy()[0]) == mj_data.ncon == mujoco.mjMAXCONPAIR
    dist = world.last_substep("contact.dist").numpy()[: mj_data.ncon]
    assert np.allclose(dist, mj_data.contact.dist, atol=1e-6)
    assert world.overflow_report().worlds["HFIELD"] == 1


def test_a_pair_of_the_model_keeps_its_own_parameters():
    mj_model = model(noise(), pairs=("rod",))
    pose_EL = lowered(mj_model, poses(), "rod", 0.002)[:4]
    ours = Contacts(mj_model, pose_EL)
    for row in range(4):
        mine, theirs = ours.of(row, "rod"), of_the_c_engine(mj_model, pose_EL[row], "rod")[0]
        assert mine["dim"][0] == theirs.dim == 4 and np.allclose(
            mine["friction"][0], theirs.friction
        )


OTHER_SHAPES = {
    "cylinder": 'type="cylinder" size="0.06 0.08"',
    "ellipsoid": 'type="ellipsoid" size="0.06 0.08 0.1"',
    "mesh": 'type="mesh" mesh="wedge"',
}


@pytest.mark.parametrize("shape", OTHER_SHAPES)
@pytest.mark.parametrize("depth", [0.0005, 0.01, 0.1])
def test_other_shapes_touch_each_prism_as_in_the_c_engine(shape, depth):
    """Directions come from a search that ends within a tolerance; a smooth shape has others nearby."""
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco>
        <asset><mesh name="wedge" vertex="-.1 -.1 -.1 .1 -.1 -.1 0 .12 -.1 0 0 .15 .05 .05 .1"/></asset>
        <worldbody>
          <body name="ball"><freejoint/><geom name="ball" {OTHER_SHAPES[shape]} margin="1e-6"/></body>
        </worldbody>
        </mujoco>"""
    )
    heights = noise()
    rows, columns = heights.shape
    size, data = [SIDE, SIDE, TOP, 0.5], heights.ravel().tolist()
    spec.add_hfield(name="field", size=size, nrow=rows, ncol=columns, userdata=data)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field")
    mj_model = load_model(spec)
    pose_EL = lowered(mj_model, poses()[:, :7], "ball", depth)
    ours, several = Contacts(mj_model, pose_EL), 0
    for row in range(NUM_ENVS):
        mine, theirs = ours.of(row, "ball"), of_the_c_engine(mj_model, pose_EL[row], "ball")
        assert len(mine["dist"]) == len(theirs) > 0, row
        several += len(theirs) > 1
        assert np.allclose(mine["dist"], [each.dist for each in theirs], atol=1e-4), row
        for each in theirs:
            nearest = int(np.linalg.norm(mine["pos"] - each.pos, axis=1).argmin())
            assert np.allclose(mine["pos"][nearest], each.pos, atol=3e-3), row
            assert np.allclose(mine["frame"][nearest, 0], each.frame[:3], atol=0.1), row
    assert several > 0
