"""A replay of stacked frames against a log of what was: random rollouts, ends, gaps, and frames equal by chance."""

import itertools
import random

import pytest
import torch
from tensordict import TensorDict

from ksim_rl.data import MASK_KEY, ReplayStorage
from ksim_rl.data.frame_stacks import FrameStacks

NUM_ENVS = 3
GAMMA = 0.5


class Logged:
    """Envs of random frames, with a log of all env states that were written: its rows are numbered by their actions."""

    def __init__(self, *, seed, stacks, colours):
        self.draw = random.Random(seed)
        self.stacks = stacks
        self.colours = colours
        self.pictures = itertools.count(1)
        self.rows = []
        self.last = [None] * NUM_ENVS
        self.frames = {key: [[] for _ in range(NUM_ENVS)] for key in (*stacks, "joints")}
        for env in range(NUM_ENVS):
            self.reset(env)

    def picture(self):
        # Without colours no two are equal.
        if self.colours is None:
            return float(next(self.pictures))
        return float(self.draw.randrange(self.colours))

    def reset(self, env):
        for own in self.frames.values():
            own[env] = [self.picture()] * 10

    def step(self, env):
        for own in self.frames.values():
            own[env].append(self.picture())

    def observed(self, env):
        seen = {"joints": torch.tensor([self.frames["joints"][env][-1]])}
        for key, ages in self.stacks.items():
            seen[key] = torch.tensor([[self.frames[key][env][-1 - age]] for age in ages])
        return seen

    def gap(self, env):
        """Reset an env, or step it, while nobody writes: the next env state follows on none."""
        if self.draw.random() < 0.5:
            self.reset(env)
        else:
            self.step(env)
        self.last[env] = None

    def rollout(self, length):
        steps = []
        for _ in range(length):
            steps.append(torch.stack([self.env_state(env) for env in range(NUM_ENVS)]))
        return torch.stack(steps, 1)

    def env_state(self, env):
        now = self.observed(env)
        self.step(env)
        done = self.draw.random() < 0.15
        following = self.observed(env) | {
            "reward": torch.tensor([float(self.draw.randrange(1, 1000))]),
            "done": torch.tensor([done]),
            "terminated": torch.tensor([done and self.draw.random() < 0.5]),
        }
        number = len(self.rows)
        self.rows.append({"now": now, "next": following, "goes_on": None})
        if self.last[env] is not None:
            self.rows[self.last[env]]["goes_on"] = number
        self.last[env] = number
        if done:
            self.last[env] = None
            self.reset(env)
        action = torch.tensor([float(number)])
        return TensorDict({**now, "action": action, "next": following}, batch_size=[])

    def expected(self, number, steps):
        """Return observation, successor, return and flags of so many steps; None where the log has not so many."""
        total = 0.0
        row = self.rows[number]
        first = row
        for step in range(steps):
            if step:
                if row["goes_on"] is None:
                    return None
                row = self.rows[row["goes_on"]]
            total += GAMMA**step * float(row["next"]["reward"])
        return first["now"], row["next"] | {"reward": torch.tensor([total])}


def wrong_entries(log, ring):
    """Count the env states of a ring that are not what was logged, and all of them."""
    sample = ring.get(torch.arange(ring.max_size))
    wrong = 0
    kept = sample[MASK_KEY].flatten().nonzero().flatten().tolist()
    for place in kept:
        own = sample[place]
        expected = log.expected(int(own["action"]), int(own["steps_to_next_obs"]))
        if expected is None:
            wrong += 1
            continue
        now, following = expected
        same = [torch.equal(own[key], value) for key, value in now.items()]
        same += [torch.equal(own["next", key], value) for key, value in following.items()]
        wrong += not all(same)
    return wrong, len(kept)


def compare(*, seed, stacks, n_step, colours, tells, rollouts=12):
    """Return how many of all entries were wrong over some rollouts with gaps, which the ring is told if `tells`."""
    log = Logged(seed=seed, stacks=stacks, colours=colours)
    observations = [*stacks, "joints"]
    ring = ReplayStorage(
        num_envs=NUM_ENVS,
        capacity=17,
        observations=observations,
        n_step=n_step,
        gamma=GAMMA,
        stacks=stacks,
    )
    wrong = 0
    entries = 0
    for _ in range(rollouts):
        is_cut = [log.draw.random() < 0.2 for _ in range(NUM_ENVS)]
        for env in range(NUM_ENVS):
            if is_cut[env]:
                log.gap(env)
        if tells:
            ring.cut(torch.tensor(is_cut))
        ring.write(log.rollout(log.draw.randrange(1, 5)))
        of_ring = wrong_entries(log, ring)
        wrong += of_ring[0]
        entries += of_ring[1]
    return wrong, entries


STRIDED = {"rgb": (4, 2, 0)}
TWO = {"rgb": (6, 3, 0), "depth": (1, 0)}


@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("stacks", [STRIDED, TWO])
def test_where_no_two_frames_are_equal_all_entries_are_what_was(stacks, n_step):
    """Gaps are seen by the frames themselves."""
    wrong, entries = compare(seed=0, stacks=stacks, n_step=n_step, colours=None, tells=False)
    assert wrong == 0 and entries > 150


@pytest.mark.parametrize("seed", range(3))
def test_where_frames_are_equal_by_chance_gaps_that_are_told_are_kept(seed):
    wrong, entries = compare(seed=seed, stacks=STRIDED, n_step=3, colours=1, tells=True)
    assert wrong == 0 and entries > 150


def test_black_pictures_do_not_tell_where_there_was_a_gap():
    """The cause: the next rollout begins with the frames that are there, and sums go on over the gap."""
    wrong, _ = compare(seed=0, stacks=STRIDED, n_step=3, colours=1, tells=False)
    assert wrong > 0


@pytest.mark.full
@pytest.mark.parametrize("colours", [None, 4, 2, 1])
@pytest.mark.parametrize("n_step", [1, 2, 3, 5])
@pytest.mark.parametrize("stacks", [STRIDED, TWO])
def test_many_rollouts(stacks, n_step, colours):
    for seed in range(6):
        wrong, entries = compare(
            seed=seed,
            stacks=stacks,
            n_step=n_step,
            colours=colours,
            tells=colours is not None,
            rollouts=60,
        )
        assert wrong == 0 and entries > 1000


def test_what_a_gap_costs_is_counted():
    """After a gap the stacks of as many env states are unknown as their oldest frames lie back, as no two are equal."""
    log = Logged(seed=1, stacks=STRIDED, colours=None)
    ring = ReplayStorage(
        num_envs=NUM_ENVS, capacity=40, observations=["rgb", "joints"], stacks=STRIDED
    )
    # No episode ends.
    log.draw.random = lambda: 1.0
    for _ in range(5):
        for env in range(NUM_ENVS):
            log.step(env)
    ring.write(log.rollout(8))
    # The oldest frame lies four steps back: the fifth env state is the first whose frames were all written.
    assert int(ring.inexact_count) == 4 * NUM_ENVS
    for env in range(NUM_ENVS):
        log.gap(env)
    ring.write(log.rollout(8))
    assert int(ring.inexact_count) == 8 * NUM_ENVS
    assert int(ring.non_finite_count) == 0
    other = ReplayStorage(
        num_envs=NUM_ENVS, capacity=40, observations=["rgb", "joints"], stacks=STRIDED
    )
    other.load_state_dict(ring.state_dict())
    assert int(other.inexact_count) == 8 * NUM_ENVS
    saved = {key: value for key, value in ring.state_dict().items() if key != "inexact_count"}
    other.load_state_dict(saved)
    assert int(other.inexact_count) == 0, "a checkpoint of before did not count"


def test_a_write_puts_each_stack_together_once(monkeypatch):
    rows = []
    read = FrameStacks.read

    def counted(self, key, of_ring, index_B):
        rows.append(len(index_B))
        return read(self, key, of_ring, index_B)

    monkeypatch.setattr(FrameStacks, "read", counted)
    log = Logged(seed=1, stacks=STRIDED, colours=None)
    ring = ReplayStorage(
        num_envs=NUM_ENVS, capacity=40, observations=["rgb", "joints"], stacks=STRIDED
    )
    ring.write(log.rollout(8))
    # Of 8 env states and the last one's successor.
    assert sum(rows) == 9 * NUM_ENVS
