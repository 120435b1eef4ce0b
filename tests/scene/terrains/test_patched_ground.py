"""Each world stands on its own patch: heights, contacts and rest positions are the C engine's on that height field."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg
from ksim_rl.scene.terrains import Ground
from tests.scene.terrains.ground_bench import (
    EDGE,
    GRID,
    NUM_ENVS,
    RADIUS,
    THINGS,
    GroundBench,
    ground_heights,
)

FIELDS = ("geom_dataid", "geom_size", "geom_aabb", "geom_rbound")


@pytest.fixture(scope="module")
def bench():
    return GroundBench()


@pytest.fixture(scope="module")
def mj_models(bench):
    return [bench.mj_model(row) for row in range(NUM_ENVS)]


def spread(low=-1.6, high=1.6, seed=0):
    return torch.empty(NUM_ENVS, 2).uniform_(
        low, high, generator=torch.Generator().manual_seed(seed)
    )


def on_ground(bench, place_E2, height):
    around_N2 = torch.cartesian_prod(*[torch.linspace(-RADIUS, RADIUS, 5)] * 2)
    top_E = bench.ground.heights(place_E2[:, None] + around_N2).amax(-1)
    return torch.cat((place_E2, top_E[:, None] + height), dim=-1)


def test_each_level_and_kind_has_its_env(bench):
    assert bench.ground.levels_E.tolist() == [0, 1, 2] * 5
    columns_E = bench.ground.patches_E - 5 * bench.ground.levels_E
    assert columns_E.tolist() == [column for column in range(5) for _ in range(3)]
    assert (
        bench.ground.half_width == 2.0 and bench.ground.num_levels == 3 and not bench.ground.is_flat
    )


def test_model_fields_are_those_that_mujoco_compiles_for_the_height_field(bench, mj_models):
    for row, mj_model in enumerate(mj_models):
        for name in FIELDS:
            ours = bench.world.field(name)[row, bench.geom].numpy().ravel()
            assert np.allclose(ours, getattr(mj_model, name)[bench.geom], atol=1e-5), (row, name)


def test_the_c_engine_takes_the_same_fields(mj_models):
    on_c = GroundBench(sim=SimCfg(engine="c"))
    for row, mj_model in enumerate(mj_models):
        for name in FIELDS:
            ours = on_c.world.field(name)[row, on_c.geom].numpy().ravel()
            assert np.allclose(ours, getattr(mj_model, name)[on_c.geom], atol=1e-5), (row, name)


def test_heights_are_where_rays_of_the_c_engine_hit(bench, mj_models):
    points_EN2 = torch.empty(NUM_ENVS, 40, 2).uniform_(
        -1.99, 1.99, generator=torch.Generator().manual_seed(1)
    )
    heights_EN = bench.ground.heights(points_EN2)
    for row, mj_model in enumerate(mj_models):
        expected = ground_heights(mj_model, points_EN2[row].double().numpy())
        assert np.allclose(heights_EN[row], expected, atol=2e-4), row


def test_beyond_the_edge_the_ground_is_that_of_the_nearest_point(bench):
    outside = torch.tensor([[3.0, 0.3], [-9.0, 9.0], [0.3, -2.0001]]).expand(NUM_ENVS, -1, -1)
    assert torch.equal(
        bench.ground.heights(outside), bench.ground.heights(outside.clamp(-2.0, 2.0))
    )


def test_clearance_is_the_height_above_the_ground(bench):
    points_E13 = torch.cat((spread(), torch.full((NUM_ENVS, 1), 5.0)), dim=-1)[:, None]
    expected = 5.0 - bench.ground.heights(points_E13[..., :2])
    assert torch.allclose(bench.ground.clearance(points_E13), expected)


def test_nothing_stands_out_above_the_origins_where_envs_start(bench, mj_models):
    """By rays all over the square in which envs start; the origin is no higher than what is right beside it."""

    def highest(mj_model, width):
        reach = np.linspace(-1.0, 1.0, 21) * min(width / 2, 1.99)
        return ground_heights(
            mj_model, np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
        ).max()

    for row, mj_model in enumerate(mj_models):
        x, y, z = bench.ground.origins_E3[row].tolist()
        cell = GRID.size / (mj_model.hfield_ncol[mj_model.geom("terrain").dataid[0]] - 1)
        assert (x, y) == (0.0, 0.0)
        assert (
            highest(mj_model, GRID.spawn_width) - 1e-4
            <= z
            <= highest(mj_model, GRID.spawn_width + 2 * cell) + 0.01
        )


def test_each_world_collides_with_its_own_patch(bench, mj_models):
    """A ball sunk a little into the ground at random places: its deepest contact is the C engine's on that patch."""
    away_E3 = torch.tensor([0.0, 0.0, 9.0]).expand(NUM_ENVS, 3)
    for seed in range(3):
        bench.place(on_ground(bench, spread(seed=seed), RADIUS - 0.004), away_E3)
        expected = []
        for row, mj_model in enumerate(mj_models):
            mj_data = bench.mj_data(row, mj_model)
            expected.append(min((contact.dist for contact in mj_data.contact), default=0.0))
        bench.world.step()
        data = bench.world.warp_data_E
        count = int(data.nacon.numpy()[0])
        world, dist = data.contact.worldid.numpy()[:count], data.contact.dist.numpy()[:count]
        deepest = [min(dist[world == row], default=0.0) for row in range(NUM_ENVS)]
        assert np.allclose(deepest, expected, atol=1e-4)
        assert sum(depth < -1e-3 for depth in expected) > NUM_ENVS / 3


def test_things_fall_as_in_the_c_engine(bench):
    """From 5 cm above, until they rest. Flat on a level prism a box touches any place, which makes it drift."""
    ball_E2, box_E2 = (spread(-0.05, 0.05, seed=seed) for seed in (0, 2))
    ball_E2[:, 0] += 0.2
    box_E2[:, 0] -= 0.2
    bench.place(on_ground(bench, ball_E2, RADIUS + 0.05), on_ground(bench, box_E2, EDGE / 2 + 0.05))
    start_EL = bench.world.qpos_EL.clone()
    steps = 100
    for _ in range(steps // 10):
        bench.world.step(10)
    for row in range(NUM_ENVS):
        mj_model = bench.mj_model(row)
        mj_data = mujoco.MjData(mj_model)
        mj_data.qpos[:] = start_EL[row].numpy()
        mujoco.mj_step(mj_model, mj_data, steps)
        reached = bench.world.qpos_EL[row].numpy()
        assert np.allclose(reached[:7], mj_data.qpos[:7], atol=1e-4), row
        if GRID.columns[row // 3] == "rough":
            assert np.allclose(reached[7:], mj_data.qpos[7:], atol=1e-3), row
        else:
            assert np.allclose(reached[7:9], mj_data.qpos[7:9], atol=2e-2), row
            assert np.allclose(reached[[9, 11, 12]], mj_data.qpos[[9, 11, 12]], atol=3e-3), row


def test_other_levels_move_the_masked_rows_only():
    bench = GroundBench(num_envs=5)
    before = {name: bench.world.field(name).clone() for name in FIELDS}
    mask_E = torch.tensor([False, True, False, True, False])
    bench.ground.set_levels(mask_E, torch.tensor([2, 2, 2, 1, 2]))
    assert bench.ground.levels_E.tolist() == [0, 2, 0, 1, 0]
    for name in FIELDS:
        field = bench.world.field(name)
        assert torch.equal(field[~mask_E], before[name][~mask_E])
        expected = bench.mj_model(1)
        assert np.allclose(
            field[1, bench.geom].numpy().ravel(), getattr(expected, name)[bench.geom], atol=1e-5
        )
    assert bench.world.field("geom_dataid")[:, bench.geom].tolist() == [0, 11, 2, 8, 4]
    assert bench.ground.origins_E3[1, 2] == pytest.approx(GRID.spawn_height(GRID.heights(2, 1)))


def test_a_height_field_of_the_robots_own_is_left_alone():
    own = '<geom name="hat" type="hfield" hfield="hat" pos="0 0 9" contype="0" conaffinity="0"/>'
    hat = '<asset><hfield name="hat" size="0.1 0.1 0.2 0.1" nrow="3" ncol="2" elevation="0 1 0 1 0 1"/></asset>'
    things = THINGS.replace("<worldbody>", f"{hat}<worldbody>{own}", 1)
    bench, twin = GroundBench(num_envs=5, things=things), GroundBench(num_envs=5)
    points_EN2 = torch.rand(5, 20, 2) * 3.0 - 1.5
    assert bench.ground.half_width == 2.0
    assert torch.equal(bench.ground.heights(points_EN2), twin.ground.heights(points_EN2))
    assert bench.world.field("geom_dataid")[:, bench.geom].tolist() == [1, 2, 3, 4, 5]
    hat_geom = bench.world.mj_model.geom("hat").id
    assert bench.world.field("geom_dataid")[:, hat_geom].tolist() == [0] * 5


def test_flat_ground_is_zero_without_end():
    ground = Ground(3, torch.device("cpu"))
    points = torch.randn(3, 4, 3)
    assert ground.is_flat and ground.half_width == float("inf")
    assert torch.equal(ground.heights(points[..., :2]), torch.zeros(3, 4))
    assert torch.equal(ground.clearance(points), points[..., 2])
    assert torch.equal(ground.origins_E3, torch.zeros(3, 3))
    assert ground.levels_E.tolist() == [0, 0, 0]
    with pytest.raises(ValueError, match="TerrainGrid"):
        ground.set_levels(torch.ones(3, dtype=torch.bool), torch.zeros(3, dtype=torch.int64))
