"""Each kind of ground has the shape that its fields say."""

import dataclasses

import numpy as np
import pytest

from ksim_rl.scene.terrains import (
    DiscreteObstacles,
    FlatPatch,
    Gaps,
    Lattice,
    NarrowBeams,
    NestedRings,
    PerlinNoise,
    PyramidSlope,
    PyramidStairs,
    RandomBoxes,
    RandomGrid,
    RandomStairs,
    RoughGround,
    SteppingStones,
    TiltedGrid,
    Waves,
)

SIZE = 8.0
KINDS = (
    FlatPatch(),
    PyramidStairs(),
    PyramidSlope(),
    RoughGround(),
    DiscreteObstacles(),
    SteppingStones(),
    Waves(),
    Gaps(),
    PerlinNoise(),
    RandomStairs(),
    RandomGrid(),
    TiltedGrid(),
    RandomBoxes(),
    NestedRings(),
    NarrowBeams(),
)


def heights(patch, difficulty=1.0, seed=0):
    return patch.heights(Lattice(SIZE, patch.cell), difficulty, np.random.default_rng(seed))


def along_x(patch, difficulty=1.0, seed=0):
    """Return x and height along the line y = 0, from the centre outwards."""
    heights_RC = heights(patch, difficulty, seed)
    middle = len(heights_RC) // 2
    return np.linspace(-SIZE / 2, SIZE / 2, len(heights_RC))[middle:], heights_RC[middle, middle:]


def runs(flags):
    """Return (start, stop) of each run of true flags, stop excluded."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(int), [0]))))
    return list(zip(edges[::2], edges[1::2], strict=True))


@pytest.mark.parametrize("patch", KINDS, ids=lambda patch: type(patch).__name__)
def test_heights_depend_on_nothing_but_difficulty_and_seed(patch):
    first = heights(patch, 0.7, seed=3)
    assert first.shape == (round(SIZE / patch.cell) + 1,) * 2 and np.isfinite(first).all()
    assert np.array_equal(first, heights(patch, 0.7, seed=3))


@pytest.mark.parametrize(("difficulty", "height"), [(0.0, 0.02), (0.5, 0.11), (1.0, 0.2)])
@pytest.mark.parametrize("inverted", [False, True])
def test_stairs_have_steps_of_one_height_and_width(difficulty, height, inverted):
    patch = PyramidStairs(
        step_height=(0.02, 0.2), step_width=0.3, platform_width=2.0, inverted=inverted, cell=0.05
    )
    x, z = along_x(patch, difficulty)
    z = z if inverted else -z
    rises = np.diff(z)
    assert np.allclose(z[x <= 1.0], z[0])
    risers = np.flatnonzero(rises)
    assert len(risers) == 10  # 3 m of 0.3 m steps
    assert np.allclose(rises[risers], height)
    assert np.allclose(x[risers], 1.0 + 0.3 * np.arange(10))


def test_stairs_are_the_same_on_all_four_sides():
    heights_RC = heights(PyramidStairs())
    assert np.array_equal(heights_RC, heights_RC.T) and np.array_equal(heights_RC, heights_RC[::-1])


@pytest.mark.parametrize(("difficulty", "gradient"), [(0.0, 0.1), (1.0, 0.5)])
@pytest.mark.parametrize(("inverted", "sign"), [(False, -1), (True, 1)])
def test_slopes_have_one_angle(difficulty, gradient, inverted, sign):
    x, z = along_x(
        PyramidSlope(gradient=(0.1, 0.5), platform_width=2.0, inverted=inverted), difficulty
    )
    assert np.allclose(z[x <= 1.0], 0.0)
    assert np.allclose(np.diff(z) / np.diff(x), np.where(x[:-1] < 1.0, 0.0, sign * gradient))


def test_rough_ground_fills_its_range_and_no_more():
    for difficulty, amplitude in ((0.0, 0.01), (1.0, 0.06)):
        z = heights(RoughGround(amplitude=(0.01, 0.06)), difficulty)
        assert 0.95 * amplitude < z.max() <= amplitude and -amplitude <= z.min() < -0.95 * amplitude
        # Independent draws: neighbours are as far apart as any two.
        assert np.isclose(np.abs(np.diff(z)).mean(), 2 / 3 * amplitude, rtol=0.1)


def test_waves_reach_their_crests_and_troughs():
    patch = Waves(amplitude=(0.0, 0.2), wave_length=2.0, cell=0.1)
    x, z = along_x(patch)
    at = {round(place, 3): height for place, height in zip(x, z, strict=True)}
    assert np.isclose(at[0.0], 0.2) and np.isclose(at[2.0], 0.2) and np.isclose(at[1.0], 0.0)
    assert np.isclose(heights(patch).min(), -0.2)
    assert np.ptp(heights(patch, 0.0)) == 0.0


def test_obstacles_have_one_height_and_leave_the_platform_free():
    patch = DiscreteObstacles(height=(0.02, 0.2), platform_width=1.5)
    z = heights(patch, 0.5)
    assert np.allclose(sorted(np.unique(z.round(9))), [-0.11, 0.0, 0.11])
    assert np.all(z[Lattice(SIZE, patch.cell).ring_RC <= 0.75] == 0.0)
    assert not np.array_equal(z, heights(patch, 0.5, seed=1))
    assert np.ptp(heights(dataclasses.replace(patch, num_obstacles=0))) == 0.0


@pytest.mark.parametrize(("difficulty", "width", "gap"), [(0.0, 0.8, 0.1), (1.0, 0.35, 0.3)])
def test_stones_and_the_gaps_between_them_have_their_widths(difficulty, width, gap):
    patch = SteppingStones(
        stone_width=(0.8, 0.35),
        gap=(0.1, 0.3),
        unevenness=(0.0, 0.05),
        depth=0.5,
        platform_width=0.0,
        cell=0.05,
    )
    row = heights(patch, difficulty)[0]
    stones = runs(row > -0.2)
    # The last one is cut off.
    assert np.allclose([(stop - 1 - start) * 0.05 for start, stop in stones[:-1]], width)
    assert np.allclose(
        [
            (after - (stop - 1)) * 0.05
            for (_, stop), (after, _) in zip(stones, stones[1:], strict=False)
        ],
        gap,
    )
    assert np.allclose(row[row <= -0.2], -0.5)
    assert np.abs(row[row > -0.2]).max() <= 0.05 * difficulty + 1e-12
    assert all(np.ptp(row[start:stop]) == 0.0 for start, stop in stones)


@pytest.mark.parametrize(("difficulty", "width"), [(0.0, 0.1), (0.6, 0.4), (1.0, 0.6)])
def test_gaps_have_their_width_and_depth(difficulty, width):
    x, z = along_x(
        Gaps(width=(0.1, 0.6), spacing=0.8, depth=0.4, platform_width=1.5, cell=0.05), difficulty
    )
    holes = runs(z < -0.2)
    brinks = [(x[start - 1], x[stop]) for start, stop in holes if stop < len(x)]
    assert np.isclose(brinks[0][0], 0.75)
    assert np.allclose([far - near for near, far in brinks], width)
    assert np.allclose([b[0] - a[1] for a, b in zip(brinks, brinks[1:], strict=False)], 0.8)
    assert np.allclose(np.unique(z), [-0.4, 0.0])


def test_perlin_noise_has_its_height_and_one_level_where_its_waves_meet():
    one = PerlinNoise(height=(0.1, 0.5), wave_length=2.0, octaves=1, cell=0.1)
    for difficulty, height in ((0.0, 0.1), (0.5, 0.3), (1.0, 0.5)):
        z = heights(one, difficulty)
        assert np.isclose(z.min(), 0.0) and np.isclose(z.max(), height)
    # Gradient noise vanishes at the points of its grid, 20 cells apart, wherever the lowest point lies.
    assert np.ptp(z[::20, ::20]) < 1e-12
    # Between them it is smooth: no step of one cell is near the whole height.
    assert np.abs(np.diff(z)).max() < 0.1
    # A second octave adds half as much, at half of the length.
    two = heights(dataclasses.replace(one, octaves=2))
    assert np.ptp(two[::20, ::20]) < 1e-12 and np.abs(two - z).max() > 0.02
    with pytest.raises(ValueError, match="octaves=4 of wave_length=1.0"):
        PerlinNoise(wave_length=1.0, octaves=4)


def test_random_stairs_rise_by_drawn_steps():
    patch = RandomStairs(
        step_height=(0.1, 0.2), least_share=0.5, step_width=0.6, platform_width=2.0
    )
    x, z = along_x(patch, 1.0)
    rises = np.diff(z)
    risers = np.flatnonzero(rises)
    assert np.allclose(x[risers], 1.0 + 0.6 * np.arange(5)) and np.allclose(z[x <= 1.0], 0.0)
    assert (
        rises[risers].min() >= 0.1 and rises[risers].max() <= 0.2 and np.ptp(rises[risers]) > 0.01
    )
    easy = np.diff(along_x(patch, 0.0)[1])
    assert np.allclose(easy, 0.5 * rises), "the same shares of half the height"


def test_a_random_grid_has_level_squares_within_its_amplitude():
    patch = RandomGrid(amplitude=(0.02, 0.2), square_width=0.5, platform_width=1.5, cell=0.1)
    z = heights(patch, 1.0)
    squares = z[:80, :80].reshape(16, 5, 16, 5).swapaxes(1, 2)
    outside = Lattice(SIZE, 0.1).ring_RC[2:80:5, 2:80:5] > 1.2
    assert np.ptp(squares[outside], axis=(-2, -1)).max() == 0.0
    assert 0.18 < np.abs(z).max() <= 0.2 and len(np.unique(squares[outside])) > 100
    assert np.all(z[Lattice(SIZE, 0.1).ring_RC <= 0.75] == 0.0)


def test_tilted_squares_are_planes_within_their_tilt():
    patch = TiltedGrid(
        tilt=(0.0, 15.0), amplitude=(0.0, 0.05), square_width=1.0, platform_width=1.0, cell=0.1
    )
    z = heights(patch, 1.0)
    squares = z[:80, :80].reshape(8, 10, 8, 10).swapaxes(1, 2)[:2].reshape(-1, 10, 10)
    # Slopes along x and y are the same everywhere in a square.
    along_x, along_y = np.diff(squares, axis=2) / 0.1, np.diff(squares, axis=1) / 0.1
    assert np.allclose(along_x, along_x[:, :1, :1]) and np.allclose(along_y, along_y[:, :1, :1])
    steepest = max(np.abs(along_x).max(), np.abs(along_y).max())
    assert 0.8 * np.tan(np.radians(15)) < steepest <= np.tan(np.radians(15)) + 1e-9
    assert np.abs(squares.mean((1, 2))).max() <= 0.05
    assert np.ptp(heights(patch, 0.0)) == 0.0


def test_boxes_stand_on_the_ground_and_are_turned():
    patch = RandomBoxes(
        height=(0.1, 0.4), least_share=0.5, width=(0.8, 0.8), num_boxes=1, platform_width=0.0
    )
    for seed in range(20):
        # One that lies wholly inside of the patch has its whole area, whichever way it is turned.
        z = heights(dataclasses.replace(patch, cell=0.02), 1.0, seed)
        on = z > 0.0
        if not (on[0].any() or on[-1].any() or on[:, 0].any() or on[:, -1].any()):
            break
    assert np.isclose(on.sum() * 0.02**2, 0.64, rtol=0.03)
    assert 0.2 <= z.max() <= 0.4 and len(np.unique(z)) == 2
    # The bounding box of a turned square is wider than the square.
    assert on.any(0).sum() * 0.02 > 0.85
    many = heights(RandomBoxes(height=(0.1, 0.4), platform_width=1.5), 1.0)
    assert (
        np.all(many[Lattice(SIZE, RandomBoxes().cell).ring_RC <= 0.75] == 0.0)
        and (many > 0.0).mean() > 0.2
    )


@pytest.mark.parametrize(("difficulty", "ring", "gap"), [(0.0, 0.6, 0.1), (1.0, 0.3, 0.3)])
def test_rings_and_the_trenches_between_them_have_their_widths(difficulty, ring, gap):
    patch = NestedRings(
        ring_width=(0.6, 0.3), gap=(0.1, 0.3), height=0.1, depth=0.4, platform_width=1.5
    )
    x, z = along_x(patch, difficulty)
    holes = runs(z < -0.3)
    brinks = [(x[start - 1], x[stop]) for start, stop in holes if stop < len(x)]
    assert np.isclose(brinks[0][0], 0.75)
    assert np.allclose([far - near for near, far in brinks], gap)
    assert np.allclose([b[0] - a[1] for a, b in zip(brinks, brinks[1:], strict=False)], ring)
    assert np.allclose(z[x <= 0.75], 0.0) and np.allclose(np.unique(z), [-0.4, 0.0, 0.1])


@pytest.mark.parametrize(("difficulty", "width"), [(0.0, 0.5), (1.0, 0.3)])
def test_beams_lead_outwards_over_a_pit(difficulty, width):
    patch = NarrowBeams(
        beam_width=(0.5, 0.3), num_beams=4, depth=0.4, platform_width=1.5, cell=0.05
    )
    z = heights(patch, difficulty)
    # At the edge of the patch one beam is left, across the x axis; as many on each side.
    beams = runs(z[:, -1] == 0.0)
    assert [(stop - 1 - start) * 0.05 for start, stop in beams] == [pytest.approx(width)]
    assert (
        np.array_equal(z, z.T) and np.array_equal(z, z[::-1]) and set(np.unique(z)) == {-0.4, 0.0}
    )
    assert np.all(z[Lattice(SIZE, 0.05).ring_RC <= 0.75] == 0.0)


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (RandomStairs, "step_width", 0.05),
        (RandomGrid, "square_width", 0.05),
        (TiltedGrid, "tilt", (0.0, 75.0)),
        (RandomBoxes, "width", (1.0, 0.3)),
        (NestedRings, "gap", (0.05, 0.3)),
        (NarrowBeams, "beam_width", (0.05, 0.5)),
        (FlatPatch, "proportion", 0.0),
        (FlatPatch, "cell", 0.0),
        (PyramidStairs, "step_height", (-0.1, 0.2)),
        (PyramidStairs, "step_width", 0.05),
        (PyramidSlope, "gradient", (0.0, -0.5)),
        (RoughGround, "amplitude", (0.0, float("nan"))),
        (DiscreteObstacles, "width", (1.0, 0.3)),
        (SteppingStones, "gap", (0.05, 0.3)),
        (Gaps, "width", (0.05, 0.6)),
        (Waves, "wave_length", 0.5),
    ],
)
def test_a_shape_that_cannot_be_is_refused_by_field(kind, field, value):
    with pytest.raises(ValueError, match=field):
        kind(**{field: value})
