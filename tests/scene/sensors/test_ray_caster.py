"""Rays hit what rays of the C engine hit."""

import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.mdp import RayDistance, RayHeight
from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.scene.sensors import (
    GridPattern,
    PinholePattern,
    RayCaster,
    RingPattern,
)
from ksim_rl.scene.terrains import RoughGround, TerrainGrid

NUM_ENVS = 3
GRID = TerrainGrid(
    patches={"rough": RoughGround(amplitude=(0.1, 0.3), cell=0.5)},
    num_levels=3,
    num_columns=1,
    size=6.0,
    max_initial_level=2,
)
SCENE = """
<mujoco>
  <worldbody>
    <body name="robot">
      <freejoint/>
      <geom name="hull" type="sphere" size="0.3" mass="1"/>
      <site name="eye" pos="0.1 0.05 0.2" quat="0.9 0.1 0.3 0.2"/>
      <body name="leg" pos="0.5 0 0"><geom name="leg" type="capsule" size="0.05 0.2" mass="1" group="3"/></body>
    </body>
    <body name="crate" pos="0.8 0.6 0.8" euler="20 0 30"><geom type="box" size="0.3 0.2 0.3"/></body>
    <geom type="sphere" pos="-1 0.3 0.7" size="0.4" group="1"/>
    <geom type="box" pos="0 -1.5 0.7" size="0.4 0.1 0.4" group="2"/>
  </worldbody>
</mujoco>
"""


class Bench:
    """Worlds with one ray caster, each on its own patch."""

    def __init__(self, sensor: RayCaster, scene: str = SCENE) -> None:
        spec = mujoco.MjSpec.from_string(scene)
        GRID.add_to(spec)
        sensor.add_to(spec, "scan")
        self.world = World(
            load_model(spec),
            num_envs=NUM_ENVS,
            sim=SimCfg(njmax=60, nconmax=30),
            per_world_fields=GRID.per_world_fields,
        )
        self.driver = EnvDriver(self.world, step_dt=0.02)
        self.view = self.driver.view
        self.driver.ground = GRID.ground(self.view)
        self.driver.add_sensors({"scan": sensor})
        self.tracker = self.view.sensors["scan"]
        quat = torch.nn.functional.normalize(torch.tensor([0.8, 0.1, -0.2, 0.5]), dim=0).tolist()
        self.place(
            torch.tensor([[0.1 * row, 0.2, 1.0 + 0.1 * row, *quat] for row in range(NUM_ENVS)])
        )

    def place(self, pose_E7) -> None:
        self.world.qpos_EL.copy_(pose_E7)
        self.world.refresh()
        self.driver.refreshed()

    def ray_of_the_c_engine(self, row, start, direction, groups, exclude):
        """Return distance (-1 for none) and normal of one ray, in the world's own model."""
        mj_model = self.world.mj_model
        terrain = mj_model.geom("terrain").id
        mj_model.geom_dataid[terrain] = int(self.world.field("geom_dataid")[row, terrain])
        mj_data = mujoco.MjData(mj_model)
        mj_data.qpos[:] = self.world.qpos_EL[row].numpy()
        mujoco.mj_kinematics(mj_model, mj_data)
        group = np.array([number in groups for number in range(6)], dtype=np.uint8)
        normal, geom = np.zeros(3), np.zeros(1, dtype=np.int32)
        distance = mujoco.mj_ray(
            mj_model, mj_data, start, direction, group, 1, exclude, geom, normal
        )
        return distance, normal

    def frame(self, row):
        """Place and orientation of the sensor's site in the C engine."""
        mj_model = self.world.mj_model
        mj_data = mujoco.MjData(mj_model)
        mj_data.qpos[:] = self.world.qpos_EL[row].numpy()
        mujoco.mj_kinematics(mj_model, mj_data)
        name = "eye" if self.tracker._sensor.site else "scan_rays"
        return mj_data.site(name).xpos.copy(), mj_data.site(name).xmat.reshape(3, 3).copy()


PATTERNS = (
    GridPattern(size=(2.0, 1.0), resolution=0.5, height=0.3),
    PinholePattern(width=5, height=4, fovy=80.0),
    RingPattern(num_rays=9, elevations=(-30.0, 0.0)),
)


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda pattern: type(pattern).__name__)
@pytest.mark.parametrize("alignment", ["site", "yaw", "world"])
def test_rays_hit_what_those_of_the_c_engine_hit(pattern, alignment):
    sensor = RayCaster(pattern=pattern, site="eye", alignment=alignment, max_distance=3.0)
    bench = Bench(sensor)
    state = bench.tracker.state
    starts, directions = pattern.rays()
    robot = bench.world.mj_model.body("robot").id
    hits = 0
    for row in range(NUM_ENVS):
        origin, matrix = bench.frame(row)
        if alignment == "yaw":
            yaw = math.atan2(matrix[1, 0], matrix[0, 0])
            matrix = np.array(
                [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
            )
        elif alignment == "world":
            matrix = np.eye(3)
        for ray, (start, direction) in enumerate(zip(starts, directions, strict=True)):
            begin, along = origin + matrix @ start, matrix @ direction
            distance, normal = bench.ray_of_the_c_engine(row, begin, along, (0, 1), robot)
            is_hit = 0 <= distance <= 3.0
            hits += is_hit
            assert bool(state.hit_EN[row, ray]) == is_hit
            expected = distance if is_hit else 3.0
            assert float(state.distance_EN[row, ray]) == pytest.approx(expected, abs=1e-4)
            assert np.allclose(state.point_EN3[row, ray], begin + expected * along, atol=2e-4)
            assert np.allclose(state.normal_EN3[row, ray], normal if is_hit else 0.0, atol=1e-3)
    assert hits > 0.2 * NUM_ENVS * len(starts)


def test_what_rays_hit_is_chosen_by_group_and_body():
    down = GridPattern(size=(0.0, 0.0))
    for fields, distance in (
        ({"body": "robot"}, 3.0),  # its own hull is left out; below is only terrain
        ({"body": "robot", "exclude_body": False}, 0.3),  # out of the hull, from inside
        ({"body": "leg", "geom_groups": (3,), "exclude_body": False, "pos": (0.0, 0.0, 1.0)}, 0.75),
    ):
        bench = Bench(RayCaster(pattern=down, alignment="world", max_distance=3.0, **fields))
        bench.place(torch.tensor([0.3, 0.3, 8.0, 1.0, 0.0, 0.0, 0.0]).expand(NUM_ENVS, 7))
        assert np.allclose(bench.tracker.state.distance_EN, distance, atol=1e-4), fields


def test_readings_follow_the_state_and_are_the_readers_own():
    bench = Bench(RayCaster(pattern=GridPattern(size=(0.0, 0.0)), body="robot", alignment="world"))
    bench.place(torch.tensor([-2.5, -2.5, 2.0, 1.0, 0.0, 0.0, 0.0]).expand(NUM_ENVS, 7))
    with bench.driver.scope("observations/x"):
        before = RayDistance(sensor="scan")(bench.view)
        held = before.clone()
        bench.place(torch.tensor([-2.5, -2.5, 3.0, 1.0, 0.0, 0.0, 0.0]).expand(NUM_ENVS, 7))
        after = RayDistance(sensor="scan")(bench.view)
        height = RayHeight(sensor="scan", offset=1.0, clip=(-5.0, 2.0))(bench.view)
    assert torch.equal(before, held) and torch.allclose(after, before + 1.0, atol=1e-5)
    assert torch.allclose(height, (after - 1.0).clamp(max=2.0), atol=1e-5)


def test_rays_over_several_sites_are_those_of_each_site_one_after_the_other():
    scene = SCENE.replace(
        '<body name="leg" pos="0.5 0 0">', '<body name="leg" pos="0.5 0 0"><site name="toe"/>'
    )
    pattern = RingPattern(num_rays=6, elevations=(-60.0,))
    both = Bench(RayCaster(pattern=pattern, sites=("eye", "toe"), max_distance=3.0), scene)
    states = [
        Bench(RayCaster(pattern=pattern, site=site, max_distance=3.0), scene)
        for site in ("eye", "toe")
    ]
    for leaf, *parts in zip(
        both.tracker.state, *(one.tracker.state for one in states), strict=True
    ):
        assert torch.equal(leaf, torch.cat(parts, dim=1))
    assert both.tracker.state.hit_EN.any() and both.tracker.state.distance_EN.shape == (
        NUM_ENVS,
        12,
    )
    origins = torch.cat([one.tracker.origin_EN3 for one in states], dim=1)
    assert torch.equal(both.tracker.origin_EN3, origins) and not torch.equal(
        origins[:, 0], origins[:, 6]
    )
    with pytest.raises(ValueError, match="no site matches 'ey'"):
        RayCaster(pattern=pattern, sites=("ey",)).add_to(mujoco.MjSpec.from_string(SCENE), "scan")
    with pytest.raises(ValueError, match="give the sites alone"):
        RayCaster(pattern=pattern, sites=("eye",), body="robot")


def test_patterns_are_what_they_say():
    start, direction = GridPattern(
        size=(1.0, 0.5), resolution=0.5, height=0.2, direction=(0, 0, -2)
    ).rays()
    assert np.allclose(
        start[:, :2],
        [[-0.5, -0.25], [0, -0.25], [0.5, -0.25], [-0.5, 0.25], [0, 0.25], [0.5, 0.25]],
    )
    assert np.allclose(start[:, 2], 0.2) and np.allclose(direction, [0, 0, -1])
    start, direction = PinholePattern(width=2, height=2, fovy=90.0).rays()
    assert np.allclose(start, 0.0)
    expected = np.array(
        [[1, 0.5, 0.5], [1, -0.5, 0.5], [1, 0.5, -0.5], [1, -0.5, -0.5]]
    ) / math.sqrt(1.5)
    assert np.allclose(direction, expected)
    _, direction = RingPattern(num_rays=4, elevations=(0.0, 45.0)).rays()
    root = math.sqrt(0.5)
    assert np.allclose(direction[:4], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], atol=1e-12)
    assert np.allclose(direction[4], [root, 0, root])


def test_what_cannot_be_is_refused_by_field():
    pattern = GridPattern()
    for fields, word in (
        ({}, "exactly one"),
        ({"site": "eye", "body": "robot"}, "exactly one"),
        ({"site": "eye", "pos": (1.0, 0.0, 0.0)}, "pos"),
        ({"body": "robot", "alignment": "up"}, "alignment"),
        ({"body": "robot", "max_distance": 0.0}, "max_distance"),
        ({"body": "robot", "geom_groups": (6,)}, "geom_groups"),
    ):
        with pytest.raises(ValueError, match=word):
            RayCaster(pattern=pattern, **fields)
    with pytest.raises(ValueError, match=r"scene\.sensors\.scan: no site 'ey': did you mean 'eye'"):
        RayCaster(pattern=pattern, site="ey").add_to(mujoco.MjSpec.from_string(SCENE), "scan")
    for kind, fields, word in (
        (GridPattern, {"resolution": 0.0}, "resolution"),
        (GridPattern, {"direction": (0.0, 0.0, 0.0)}, "direction"),
        (PinholePattern, {"fovy": 180.0}, "fovy"),
        (PinholePattern, {"width": 0}, "width"),
        (RingPattern, {"elevations": ()}, "elevations"),
        (RingPattern, {"num_rays": 0}, "num_rays"),
    ):
        with pytest.raises(ValueError, match=word):
            kind(**fields)
