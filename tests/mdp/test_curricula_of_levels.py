"""What drives the level: when it moves, by how much, and that it is saved."""

import pytest
import torch

from ksim_rl import mdp
from tests.envs.probe_env import DT, Launch, Position, puck_env_in_c


def run(env, steps):
    """Step through the ends of episodes; return the level that each step's reset left."""
    root_E, levels = env.reset(), []
    for _ in range(steps):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(env.num_envs, 1)))
        levels.append(round(float(env.view.level), 4))
    return levels


def leveled(term, *, steps=2, **fields):
    """Pucks whose episodes last `steps` steps."""
    return puck_env_in_c(
        limit=None, episode_length_s=steps * DT, curriculum={"level": term}, **fields
    )


def test_linear_rises_between_two_counts_of_steps_when_envs_reset():
    env = leveled(mdp.LinearLevel(begin_step=4, end_step=12))
    assert run(env, 14) == [0, 0, 0, 0, 0, 0.25, 0.25, 0.5, 0.5, 0.75, 0.75, 1.0, 1.0, 1.0]
    assert env.curriculum_levels()["level"] == 1.0


def test_a_level_begins_where_it_is_told():
    env = leveled(mdp.LinearLevel(end_step=4, initial_level=0.5))
    assert env.view.level == 0.5 and run(env, 4) == [0.5, 0.75, 0.75, 1.0]


def test_stock_resets_and_masked_ones_give_the_same_levels():
    masked, stock = (leveled(mdp.LinearLevel(end_step=16), steps=4) for _ in range(2))
    levels = run(masked, 9)
    root_E, seen = stock.reset(), []
    for _ in range(9):
        next_E = stock.step(root_E.set("action", torch.zeros(3, 1)))["next"].clone()
        root_E = (
            stock.reset(next_E.set("_reset", next_E["done"])) if next_E["done"].any() else next_E
        )
        seen.append(round(float(stock.view.level), 4))
    assert seen == levels == [0, 0, 0, 0.25, 0.25, 0.25, 0.25, 0.5, 0.5]


def test_long_episodes_raise_the_level_and_short_ones_lower_it():
    # Env e moves at 0.02 (e + 1) m a step: beyond 0.05 m after 3, 2, 1 of 4 steps.
    term = mdp.EpisodeLengthLevel(raise_above=0.9, lower_below=0.6, num_levels=4, initial_level=0.5)
    survivors = leveled(term, steps=4)
    assert run(survivors, 8) == [0.5] * 3 + [0.75] * 4 + [1.0]
    fallers = puck_env_in_c(limit=0.05, episode_length_s=4 * DT, curriculum={"level": term})
    # Three episodes have ended after step 2, with 1, 1 and 2 steps; three more after step 3 already count from zero.
    assert run(fallers, 2) == [0.5, 0.25]


def test_between_the_thresholds_nothing_moves():
    term = mdp.EpisodeLengthLevel(raise_above=1.0, lower_below=1.0, initial_level=0.5)
    assert run(leveled(term), 8) == [0.5] * 8


def test_a_level_waits_for_enough_episodes():
    term = mdp.EpisodeLengthLevel(num_levels=2, min_episodes=7)
    # Three episodes end in steps 2, 4, 6, ...: seven have after step 6, and again after step 12.
    assert run(leveled(term), 12) == [0] * 5 + [0.5] * 6 + [1.0]


def test_episodes_that_a_reset_cuts_before_their_first_step_do_not_count():
    env = leveled(mdp.EpisodeLengthLevel(num_levels=2, min_episodes=1))
    for _ in range(5):
        env.reset()
    assert env.view.level == 0.0


def test_first_episodes_that_were_staggered_count_by_their_own_length():
    env = leveled(mdp.EpisodeLengthLevel(raise_above=0.99, num_levels=1), steps=50)
    env.reset()
    env.stagger_episodes_()
    root_E = env.reset(env_ids=[])
    for _ in range(50):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
    assert env.view.level == 1.0


def test_distance_counts_at_the_end():
    # Env e is 0.04 (e + 1) m away after two steps: 0.08 m on average.
    events = {"launch": Launch()}
    for threshold, levels in ((0.079, [0, 0.1]), (0.081, [0, 0])):
        env = leveled(mdp.DistanceLevel(raise_above=threshold), events=events)
        assert run(env, 2) == levels


def test_saturation_is_what_the_log_shows_of_a_reward():
    # Positions 0.02 (e + 1) and 0.04 (e + 1): mean 0.06 per second of the longest episode, times the weight 2.
    rewards = {"position": Position(weight=2.0)}
    for threshold, level in ((0.119, 0.1), (0.121, 0.0)):
        env = leveled(
            mdp.SaturationLevel(reward="position", raise_above=threshold), rewards=rewards
        )
        assert run(env, 2)[-1] == level
        log = env.episode_log()
        assert float(log["reward/position"] / log["episodes"]) / (2 * DT) == pytest.approx(0.12)


def test_the_level_and_what_it_waits_for_are_part_of_the_state():
    def env():
        return leveled(mdp.EpisodeLengthLevel(num_levels=4, min_episodes=4))

    first, second = env(), env()
    levels = run(first, 5)
    saved = first.state_dict()
    second.reset()
    second.load_state_dict(saved)
    assert second.view.level == levels[-1] == 0.25
    going_on = [first, second]
    for _ in range(5):
        for each in going_on:
            root_E = each.reset(env_ids=[])
            each.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
    assert first.view.level == second.view.level == 0.5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: mdp.LinearLevel(begin_step=5, end_step=5),
            r"end_step=5: expected a finite number in \(5, inf\)",
        ),
        (lambda: mdp.LinearLevel(end_step=5, initial_level=2.0), r"initial_level=2\.0"),
        (lambda: mdp.DistanceLevel(raise_above=1.0, lower_below=2.0), r"lower_below=2\.0"),
        (lambda: mdp.DistanceLevel(raise_above=1.0, num_levels=0), "num_levels=0"),
        (lambda: mdp.DistanceLevel(raise_above=1.0, min_episodes=0), "min_episodes=0"),
        (
            lambda: leveled(mdp.SaturationLevel(reward="positon", raise_above=1.0)),
            "unknown reward 'positon'",
        ),
        (
            lambda: puck_env_in_c(limit=None, curriculum={"level": mdp.EpisodeLengthLevel()}),
            "EpisodeLengthLevel with episode_length_s=0",
        ),
        (
            lambda: puck_env_in_c(
                curriculum={"one": mdp.LinearLevel(end_step=5), "two": mdp.LinearLevel(end_step=5)}
            ),
            "one and two all drive the one level",
        ),
    ],
)
def test_what_does_not_fit_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
