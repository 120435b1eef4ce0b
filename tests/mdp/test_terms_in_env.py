"""Commands, events, terminations, metrics and curricula together in an env: no waiting, no mixing of rows, no loss."""

import pytest
import torch

from ksim_rl.testing import count_syncs
from tests.mdp.busy_env import NUM_ENVS, busy_env, write_clip


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("clips") / "sink.npz")


def action(step):
    return torch.sin(torch.arange(NUM_ENVS) + 0.7 * step)[:, None]


def run(env, root_E, steps, start=0):
    states = []
    for step in range(start, start + steps):
        state_E, root_E = env.step_and_maybe_reset(root_E.clone().set("action", action(step)))
        states.append(state_E.clone())
    return states, root_E


def same(first, second):
    assert all(torch.equal(first[key], second[key]) for key in first.keys(True, True))


def test_steps_and_resets_never_make_the_host_wait_and_stay_finite(clip):
    env = busy_env(clip)
    root_E = env.reset()
    with count_syncs() as syncs:
        states, _ = run(env, root_E, 30)
    assert syncs.total == 0, syncs.report()
    assert all(
        torch.isfinite(leaf).all() for state_E in states for leaf in state_E.values(True, True)
    )
    log = env.episode_log()
    assert (
        log["episodes"] >= NUM_ENVS
        and log["termination/non_finite"] == log["termination/broken"] == 0
    )
    levels = {**env.curriculum_levels(), **env.command_levels()}
    assert 0.0 < levels["level"] <= 1.0 and levels["weight"] == levels["heights"] == levels["level"]
    assert (
        levels["stage"] == 2.0 and levels["ranges"] == 1.0 and levels["twist/lin_vel_x_high"] == 2.0
    )


def test_stock_resets_give_the_same_rollout(clip):
    env, stock = busy_env(clip), busy_env(clip)
    states, _ = run(env, env.reset(), 30)
    root_E = stock.reset()
    for step, expected_E in enumerate(states):
        state_E = stock.step(root_E.clone().set("action", action(step)))
        same(state_E, expected_E)
        root_E = state_E["next"].exclude("reward")
        if root_E["done"].any():
            root_E = stock.reset(root_E.set("_reset", root_E["done"].clone()))


def test_a_partial_reset_leaves_the_other_rows_bit_identical(clip):
    # Curricula join the rows on purpose: what one has mastered is harder for all.
    env, twin = (busy_env(clip, curricula=False) for _ in range(2))
    states = [run(each, each.reset(), 4)[1] for each in (env, twin)]
    rest = [0, 2, 4, 5]
    fresh_E = env.reset(states[0].clone(), env_ids=[1, 3])
    same(fresh_E[rest], states[1][rest])
    after, _ = run(env, fresh_E, 3, start=4)
    expected, _ = run(twin, states[1], 3, start=4)
    for first, second in zip(after, expected, strict=True):
        same(first[rest], second[rest])


def test_a_state_dict_continues_bit_exactly(clip):
    env, other = busy_env(clip), busy_env(clip)
    _, root_E = run(env, env.reset(), 9)
    env.command_manager.set("stick", [0.5])
    saved = env.state_dict()
    expected, _ = run(env, root_E, 12, start=9)
    other.seed(77)
    run(other, other.reset(), 3)
    other.load_state_dict(saved)
    actual, _ = run(other, root_E, 12, start=9)
    for first, second in zip(actual, expected, strict=True):
        same(first, second)
    assert actual[1]["command", "stick"].eq(0.5).all()
