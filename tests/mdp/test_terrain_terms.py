"""Terms that read the terrain: levels by how far robots walk, the edge of a patch, and scans of the ground."""

import math

import numpy as np
import pytest
import torch

from ksim_rl.mdp import HeightScan, OutsideTerrain, TerrainLevels, Upright
from tests.scene.terrains.ground_bench import GRID, NUM_ENVS, GroundBench, ground_heights

EVERYBODY = torch.ones(NUM_ENVS, dtype=torch.bool)


@pytest.fixture(scope="module")
def bench():
    return GroundBench()


def stand(bench, place_EN, yaw=0.0):
    """Put the ball somewhere, 0.5 m above the origin's height, turned about z."""
    place_E2 = torch.as_tensor(place_EN, dtype=torch.float32).expand(bench.world.num_envs, 2)
    height_E1 = bench.ground.origins_E3[:, 2:] + 0.5
    bench.place(torch.cat((place_E2, height_E1), dim=-1), torch.zeros(bench.world.num_envs, 3))
    bench.world.qpos_EL[:, 3], bench.world.qpos_EL[:, 6] = math.cos(yaw / 2), math.sin(yaw / 2)
    bench.world.refresh()
    bench.driver.refreshed()


def read(bench, term):
    with bench.driver.scope("observations/x"):
        return term(bench.view)


# -- levels ------------------------------------------------------------------------------------------------------


def adapt(bench, mask_E, count=0):
    with bench.driver.scope("curriculum/x", torch.full_like(bench.view.reset_count_E, count)):
        return TerrainLevels(command="twist")(bench.view, mask_E)


def walked(bench, distances, *, levels, steps=100, speed=0.2):
    """Give five envs levels, episodes of `steps` and commands of `speed` m/s, and robots that far from their origins.

    Half a patch is 2 m, so 1.6 m are enough to go up; in 10 s of 0.2 m/s a robot should walk 2 m, so less than 1 m is
    too little.
    """
    everybody_E = torch.ones(5, dtype=torch.bool)
    bench.ground.set_levels(everybody_E, torch.tensor(levels))
    bench.view.episode_step_E.copy_(torch.as_tensor(steps).expand(5))
    bench.driver.readings.commands["twist"] = torch.tensor(
        [[0.6 * speed, 0.8 * speed, 0.5]]
    ).expand(5, 3)
    angle_E = torch.arange(5.0)
    distance_E = torch.tensor(distances)
    stand(bench, torch.stack((distance_E * angle_E.cos(), distance_E * angle_E.sin()), dim=-1))


@pytest.fixture(scope="module")
def five():
    return GroundBench(num_envs=5)


def test_levels_rise_with_a_long_way_and_fall_with_a_short_one(five):
    walked(five, (1.61, 1.59, 1.01, 0.99, 0.0), levels=(0, 0, 1, 1, 1))
    level = adapt(five, torch.ones(5, dtype=torch.bool))
    assert five.ground.levels_E.tolist() == [1, 0, 1, 0, 0]
    assert level.shape == () and float(level) == pytest.approx(0.4)


def test_levels_do_not_fall_below_the_first(five):
    walked(five, (0.0,) * 5, levels=(0, 1, 2, 0, 1))
    adapt(five, torch.ones(5, dtype=torch.bool))
    assert five.ground.levels_E.tolist() == [0, 0, 1, 0, 0]


def test_who_stands_still_as_commanded_stays(five):
    walked(five, (0.0,) * 5, levels=(0, 1, 2, 0, 1), speed=0.0)
    adapt(five, torch.ones(5, dtype=torch.bool))
    assert five.ground.levels_E.tolist() == [0, 1, 2, 0, 1]


def test_only_rows_that_reset_after_an_episode_move(five):
    walked(five, (1.7,) * 5, levels=(0,) * 5, steps=(100, 100, 0, 100, 0))
    adapt(five, torch.tensor([True, False, True, True, False]))
    assert five.ground.levels_E.tolist() == [1, 0, 0, 1, 0]


def test_a_master_of_the_last_level_goes_on_at_a_random_one(five):
    seen = []
    for count in range(40):
        walked(five, (1.7,) * 5, levels=(2,) * 5)
        adapt(five, torch.ones(5, dtype=torch.bool), count)
        seen += five.ground.levels_E.tolist()
    # 200 uniform draws: each of three levels within five standard deviations of a third.
    assert all(abs(seen.count(level) - 200 / 3) < 34 for level in range(3)) and set(seen) == {
        0,
        1,
        2,
    }


# -- the edge ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "is_outside"),
    [((1.49, -1.49), False), ((1.51, 0.0), True), ((0.0, -1.51), True), ((-5.0, 3.0), True)],
)
def test_the_edge_of_the_terrain_ends_episodes(bench, place, is_outside):
    stand(bench, place)
    term = OutsideTerrain(margin=0.5)
    assert term.time_out and torch.equal(read(bench, term), EVERYBODY & is_outside)


# -- scans -------------------------------------------------------------------------------------------------------


def test_a_scan_reads_the_ground_where_rays_of_the_c_engine_hit_it(bench):
    yaw, place = 0.7, (0.3, -0.4)
    stand(bench, place, yaw)
    scan = read(bench, HeightScan(size=(0.8, 0.4), resolution=0.2, offset=0.25, clip=(-0.5, 0.5)))
    assert scan.shape == (NUM_ENVS, 5 * 3)
    points = [
        (
            place[0] + x * math.cos(yaw) - y * math.sin(yaw),
            place[1] + x * math.sin(yaw) + y * math.cos(yaw),
        )
        for y in (-0.2, 0.0, 0.2)
        for x in (-0.4, -0.2, 0.0, 0.2, 0.4)
    ]
    for row in range(NUM_ENVS):
        root = float(bench.ground.origins_E3[row, 2]) + 0.5
        expected = torch.tensor(root - ground_heights(bench.mj_model(row), points) - 0.25).clamp(
            -0.5, 0.5
        )
        assert torch.allclose(scan[row].double(), expected, atol=2e-4), GRID.columns[row // 3]
    assert float(scan[:3].std()) == pytest.approx(0.0, abs=1e-6) and float(scan[3:].std()) > 0.01


def test_a_scan_does_not_turn_with_tilt(bench):
    stand(bench, (0.0, 0.0))
    upright = read(bench, HeightScan())
    bench.world.qpos_EL[:, 3], bench.world.qpos_EL[:, 4] = math.cos(0.3), math.sin(0.3)
    bench.world.refresh()
    bench.driver.refreshed()
    assert torch.allclose(read(bench, HeightScan()), upright, atol=1e-6)


def test_upright_along_the_ground_is_about_the_plane_that_rays_of_the_c_engine_hit(bench):
    yaw, place, std = 0.7, (0.9, -0.2), 0.45
    stand(bench, place, yaw)
    grid = [(x, y) for y in np.linspace(-0.5, 0.5, 11) for x in np.linspace(-0.8, 0.8, 17)]
    taken = [grid[int(i)] for i in np.linspace(0, 186, 32)]
    cos, sin = math.cos(yaw), math.sin(yaw)
    points = np.array([(cos * x - sin * y, sin * x + cos * y) for x, y in taken]) + place
    found = read(bench, Upright(std=std, along="ground"))
    pitched = read(bench, Upright(std=std, along="ground", about="pitch"))
    expected = []
    ahead = []
    for row in range(NUM_ENVS):
        hits = np.column_stack((points, ground_heights(bench.mj_model(row), points)))
        _, variances, axes = np.linalg.svd(hits - hits.mean(0))
        normal = axes[2] if variances[2] ** 2 < 0.1 * variances[1] ** 2 else np.array([0, 0, 1.0])
        # The ball is turned about z alone: the sine of its tilt is of the normal's horizontal part.
        expected.append(math.exp(-float(normal[:2] @ normal[:2]) / std**2))
        ahead.append(math.exp(-((normal[0] * cos + normal[1] * sin) ** 2) / std**2))
    assert found.tolist() == pytest.approx(expected, abs=2e-4)
    assert pitched.tolist() == pytest.approx(ahead, abs=2e-4)
    # Flat ground, then the steepest slope.
    assert found[0] == 1.0 and min(expected) < 0.9
    assert bool((read(bench, Upright(std=std)) == 1.0).all())


@pytest.mark.parametrize(
    ("term", "field", "value"),
    [
        (HeightScan, "resolution", 0.0),
        (HeightScan, "size", (-1.0, 1.0)),
        (HeightScan, "clip", (1.0, -1.0)),
        (OutsideTerrain, "margin", -0.1),
    ],
)
def test_what_cannot_be_is_refused_by_field(term, field, value):
    with pytest.raises(ValueError, match=field):
        term(**{field: value})
    with pytest.raises(ValueError, match="up_distance"):
        TerrainLevels(command="twist", up_distance=1.5)
