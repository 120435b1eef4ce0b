"""First episodes that end at random times, so that envs which started together do not all end together."""

import torch

from ksim_rl.testing import count_syncs
from tests.envs.probe_env import DT, puck_env

E, STEPS = 64, 8


def ends(env, steps):
    """Return in which steps each env ends, from a staggered start, bool [steps, E]."""
    root_E, done = env.reset(), []
    env.stagger_episodes_()
    for _ in range(steps):
        env_state_E, root_E = env.step_and_maybe_reset(
            root_E.set("action", torch.zeros(env.num_envs, 1))
        )
        done.append(env_state_E["next", "done"][:, 0].clone())
    return torch.stack(done)


def staggered(seed=0, length=STEPS):
    return puck_env(num_envs=E, limit=None, episode_length_s=length * DT, seed=seed)


def test_first_episodes_have_every_length_up_to_the_full_one_and_later_ones_are_full():
    done = ends(staggered(), 3 * STEPS)
    first = done.float().argmax(0) + 1
    assert sorted(first.unique().tolist()) == list(range(1, STEPS + 1))
    for row in range(E):
        expected = torch.arange(int(first[row]), 3 * STEPS + 1, STEPS)
        assert torch.equal(done[:, row].nonzero().flatten() + 1, expected)


def test_the_seed_decides():
    assert torch.equal(ends(staggered(seed=1), STEPS), ends(staggered(seed=1), STEPS))
    assert not torch.equal(ends(staggered(seed=1), STEPS), ends(staggered(seed=2), STEPS))


def test_episodes_without_an_end_stay_so():
    assert not ends(staggered(length=0), STEPS).any()


def test_it_never_makes_the_host_wait():
    env = staggered()
    env.reset()
    with count_syncs() as syncs:
        env.stagger_episodes_()
    assert syncs.total == 0, syncs.report()
