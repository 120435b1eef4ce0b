import math

import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import FREE_BODY, Bench

E = 4000


def command(**changes):
    figures = {
        "resampling_time_range_s": (3.0, 8.0),
        "lin_vel_x": (-1.0, 0.8),
        "lin_vel_y": (-0.5, 0.25),
        "ang_vel_z": (-0.5, 0.5),
    }
    return mdp.UniformVelocityCommand(**(figures | changes))


@pytest.fixture(scope="module")
def crowd():
    return Bench(FREE_BODY, E, {})


def draw(bench, term, mask_E=None, scope="commands/twist"):
    with bench.driver.scope(scope):
        term.resample(bench.view, bench.everybody_E if mask_E is None else mask_E)
        return term(bench.view)


def headed(bench, yaw):
    bench.place(qpos=(0, 0, 1, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2), 0, 0))


def test_plain_commands_fill_their_ranges_evenly(crowd):
    value = draw(crowd, command(), scope="commands/plain")
    for column, (low, high) in enumerate(((-1.0, 0.8), (-0.5, 0.25), (-0.5, 0.5))):
        drawn = value[:, column]
        assert low <= drawn.min() < low + 0.02 and high - 0.02 < drawn.max() <= high
        # The mean of n uniform draws has the standard error (high - low) / sqrt(12 n).
        assert abs(drawn.mean() - (low + high) / 2) < 4.0 * (high - low) / math.sqrt(12 * E)


def test_kinds_come_with_their_probabilities(crowd):
    headed(crowd, 0.0)
    value = draw(crowd, command(rel_standing_envs=0.1), scope="commands/stand")
    standing = (value == 0.0).all(-1).float().mean()
    assert abs(standing - 0.1) < 4.0 * math.sqrt(0.09 / E)
    value = draw(crowd, command(rel_forward_envs=0.2), scope="commands/forward")
    forward = ((value[:, 1] == 0.0) & (value[:, 2] == 0.0)).float().mean()
    assert abs(forward - 0.2) < 4.0 * math.sqrt(0.16 / E)


def test_forward_commands_go_ahead_at_a_least_speed(crowd):
    value = draw(crowd, command(rel_forward_envs=1.0), scope="commands/ahead")
    assert (value[:, 1:] == 0.0).all()
    assert value[:, 0].min() == pytest.approx(0.3) and value[:, 0].max() <= 1.0
    # |vx| <= 0.3 has the probability 0.6 / 1.8.
    assert abs((value[:, 0] == 0.3).float().mean() - 1 / 3) < 4.0 * math.sqrt(2 / 9 / E)


def test_heading_control_turns_the_short_way_within_the_yaw_range(crowd):
    term = command(rel_heading_envs=1.0, heading=(3.0, 3.0), heading_stiffness=0.5)
    headed(crowd, 2.5)
    value = draw(crowd, term, scope="commands/heading")
    torch.testing.assert_close(value[:, 2], torch.full((E,), 0.25), atol=1e-4, rtol=0)
    headed(crowd, -3.0)  # the error is 6 rad, or 6 - 2 pi = -0.283 the other way
    with crowd.driver.scope("commands/heading"):
        value = term(crowd.view)
    torch.testing.assert_close(
        value[:, 2], torch.full((E,), 0.5 * (6.0 - 2 * math.pi)), atol=1e-4, rtol=0
    )
    headed(crowd, 0.0)
    with crowd.driver.scope("commands/heading"):
        assert (term(crowd.view)[:, 2] == 0.5).all()


def test_standing_wins_over_heading_control(crowd):
    headed(crowd, 1.0)
    term = command(rel_heading_envs=1.0, rel_standing_envs=1.0, rel_forward_envs=1.0)
    assert (draw(crowd, term, scope="commands/all") == 0.0).all()


def test_resampling_some_rows_leaves_the_others_bit_identical(crowd):
    term = command(rel_heading_envs=0.3, rel_standing_envs=0.1, rel_forward_envs=0.2)
    before = draw(crowd, term, scope="commands/some").clone()
    mask = torch.zeros(E, dtype=torch.bool)
    mask[::3] = True
    crowd.view.step_count.add_(1)
    after = draw(crowd, term, mask, scope="commands/some")
    assert torch.equal(after[~mask], before[~mask])
    assert (after[mask] != before[mask]).any(-1).float().mean() > 0.8


def test_bad_figures_are_refused():
    for field, value in (
        ("rel_standing_envs", 1.5),
        ("lin_vel_x", (1.0, -1.0)),
        ("resampling_time_range_s", (5.0, 3.0)),
        ("heading_stiffness", -1.0),
    ):
        with pytest.raises(ValueError, match=field):
            command(**{field: value})


def test_debug_drawing_shows_command_and_velocity(free_body):
    class Recorder:
        def __init__(self):
            self.arrows = []

        def arrow(self, start, end, *, rgba, width=0.02):
            self.arrows.append([float(x) for x in end - start])

    half = math.pi / 4
    free_body.place(
        qpos=(0, 0, 1, math.cos(half), 0, 0, math.sin(half), 0, 0), qvel=(1, 0, 0, 0, 0, 0, 0, 0)
    )
    term, recorder = command(lin_vel_x=(1.0, 1.0), lin_vel_y=(0.0, 0.0)), Recorder()
    draw(free_body, term)
    with free_body.driver.scope("commands/twist"):
        term.draw_debug(free_body.view, recorder, 1)
    assert recorder.arrows[0] == pytest.approx([0.0, 0.5, 0.0], abs=1e-5)  # ahead, which is world y
    assert recorder.arrows[1] == pytest.approx([0.5, 0.0, 0.0], abs=1e-5)


def test_world_commands_turn_against_the_heading(crowd):
    world = command(rel_world_envs=0.3, rel_forward_envs=0.5)
    headed(crowd, 0.0)
    plain = draw(crowd, command(rel_forward_envs=0.5), scope="commands/world")
    straight = draw(crowd, world, scope="commands/world")
    headed(crowd, 0.7)
    with crowd.driver.scope("commands/world"):
        turned = world(crowd.view)
    # Rows whose command depends on the heading; the others are as without this kind of command.
    is_world = (turned - straight).abs().amax(-1) > 1e-6
    assert abs(is_world.float().mean() - 0.3) < 4.0 * math.sqrt(0.21 / E)
    assert torch.equal(straight[~is_world], plain[~is_world])
    torch.testing.assert_close(turned[:, 2], plain[:, 2])
    c, s = math.cos(0.7), math.sin(0.7)
    x, y = straight[is_world, 0], straight[is_world, 1]
    expected = torch.stack((c * x + s * y, -s * x + c * y), dim=-1)
    torch.testing.assert_close(turned[is_world, :2], expected)
    # Those that are forward envs, too, go where they were drawn to, and keep to their heading.
    both = is_world & (plain[:, 1] == 0.0)
    assert both.any() and (straight[both, 1] != 0.0).all() and (straight[both, 2] == 0.0).all()
