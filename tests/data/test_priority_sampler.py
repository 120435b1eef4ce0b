"""Prioritized draws against the paper's formulas, in stock buffers and in a ring."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

from ksim_rl.data import MASK_KEY, PrioritySampler, ReplayCfg, ReplayRing
from ksim_rl.testing import count_syncs
from tests.data.test_replay_storage import NUM_ENVS, _History

ALPHA, BETA = 0.7, 0.5


def _buffer(sampler, size=50, batch_size=20_000):
    buffer = ReplayBuffer(storage=LazyTensorStorage(64), sampler=sampler, batch_size=batch_size)
    buffer.extend(TensorDict({"number": torch.arange(size)}, [size]))
    buffer.update_priority(torch.arange(size), torch.linspace(0.1, 5.0, size))
    return buffer


def test_probabilities_and_weights_are_those_of_the_paper():
    torch.manual_seed(0)
    data, info = _buffer(PrioritySampler(64, alpha=ALPHA, beta=BETA)).sample(return_info=True)
    score = torch.linspace(0.1, 5.0, 50) ** ALPHA
    chance = score / score.sum()
    # Stratified: no count is off by more than the two shares that it has in part.
    assert (torch.bincount(data["number"], minlength=50) - chance * 20_000).abs().max() < 2.0
    # (N P)^-beta over its largest value, in the paper's notation.
    weight = (50 * chance) ** -BETA
    torch.testing.assert_close(info["priority_weight"], (weight / weight.max())[data["number"]])


def test_new_entries_have_the_highest_priority_so_far():
    torch.manual_seed(0)
    buffer = _buffer(PrioritySampler(64, alpha=1.0, beta=0.0))
    buffer.extend(TensorDict({"number": torch.arange(50, 52)}, [2]))
    counts = torch.bincount(buffer.sample()["number"], minlength=52)
    assert (counts[49:] - counts[49]).abs().max() <= 2


def test_works_in_stock_buffers():
    torch.manual_seed(0)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(64),
        sampler=PrioritySampler(64, alpha=1.0, beta=0.5),
        batch_size=8,
    )
    buffer.extend(TensorDict({"number": torch.arange(64)}, [64]))
    sample = buffer.sample()
    buffer.update_priority(sample["index"], torch.full((8,), 1e6))
    again = buffer.sample()
    assert set(again["number"].tolist()) <= set(sample["number"].tolist())
    assert "priority_weight" in again.keys()


def test_the_highest_priority_of_a_repeated_index_counts_and_bad_ones_do_not_spread():
    sampler = PrioritySampler(4)
    sampler.extend(torch.arange(4))
    sampler.update_priority(torch.tensor([1, 1, 2]), torch.tensor([3.0, 1.0, float("nan")]))
    torch.testing.assert_close(sampler.state_dict()["priority"], torch.tensor([1.0, 3.0, 3.0, 1.0]))
    assert sampler.state_dict()["highest"] == 3.0


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0])
def test_a_bad_priority_is_the_default_one(bad):
    sampler = PrioritySampler(3)
    sampler.extend(torch.arange(3))
    sampler.update_priority(torch.tensor([1]), bad)
    assert sampler.state_dict()["priority"].tolist() == [1.0, 1.0, 1.0]
    sampler.update_priority(torch.tensor([0, 1, 2]), torch.tensor([0.25, bad, 0.0]))
    assert sampler.state_dict()["priority"].tolist() == [0.25, 0.25, 0.0]
    assert sampler.state_dict()["highest"] == 0.25


def test_priorities_of_zero_are_drawn_alike():
    torch.manual_seed(0)
    sampler = PrioritySampler(64)
    buffer = _buffer(sampler)
    buffer.update_priority(torch.arange(50), torch.zeros(50))
    data, info = buffer.sample(return_info=True)
    assert (torch.bincount(data["number"], minlength=50) - 400).abs().max() <= 2
    torch.testing.assert_close(info["priority_weight"], torch.ones(20_000))


def test_a_storage_of_two_dims_is_refused():
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(24, ndim=2), sampler=PrioritySampler(24), batch_size=8
    )
    buffer.extend(TensorDict({"number": torch.arange(24).view(4, 6)}, [4, 6]))
    with pytest.raises(ValueError, match="ndim=2"):
        buffer.sample()


def test_in_a_ring_only_env_states_are_drawn_without_syncs():
    sizes = ReplayCfg(
        num_env_states_per_minibatch=3000,
        num_minibatches=1,
        num_steps=5,
        capacity=20,
        prioritized=True,
    )
    ring = ReplayRing(sizes, num_envs=NUM_ENVS, observations=["actor", "critic"])
    history = _History(end=0.4)
    for _ in range(7):
        ring.extend(history.rollout(5))
    rollout = history.rollout(5)
    with count_syncs() as syncs:
        ring.extend(rollout)
        (minibatch,) = ring.minibatches(1)
        ring.update_priority(minibatch["index"], torch.ones(3000))
    assert syncs.total == 0, syncs.report()
    assert minibatch[MASK_KEY].all()
    assert minibatch["actor"][:, 0].unique().shape[0] == ring.num_stored
    other = ReplayRing(sizes, num_envs=NUM_ENVS, observations=["actor", "critic"])
    other.load_state_dict(ring.state_dict())
    draws = []
    for one in (ring, other):
        torch.manual_seed(3)
        draws.append(next(one.minibatches(1)))
    assert (draws[0] == draws[1]).all()


def test_a_ring_without_a_finite_env_state_gives_masked_rows_of_finite_weight():
    sizes = ReplayCfg(
        num_env_states_per_minibatch=8,
        num_minibatches=1,
        num_steps=2,
        capacity=20,
        prioritized=True,
    )
    ring = ReplayRing(sizes, num_envs=NUM_ENVS, observations=["actor", "critic"])
    rollout = _History().rollout(2)
    rollout["next", "reward"].fill_(torch.nan)
    ring.extend(rollout)
    (minibatch,) = ring.minibatches(1)
    assert not minibatch[MASK_KEY].any() and minibatch["priority_weight"].isfinite().all()


@pytest.mark.parametrize("field", [{"alpha": -1.0}, {"beta": -1.0}, {"eps": 0.0}])
def test_what_it_refuses(field):
    with pytest.raises(ValueError, match=next(iter(field))):
        PrioritySampler(4, **field)
