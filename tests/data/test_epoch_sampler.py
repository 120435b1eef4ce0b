import itertools
import json

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement

from ksim_rl.data import EpochSampler
from ksim_rl.testing import count_syncs


def _buffer(size=12, batch_size=4, ndim=1, cls=ReplayBuffer, **kwargs):
    buffer = cls(
        storage=LazyTensorStorage(size, ndim=ndim),
        sampler=EpochSampler(**kwargs),
        batch_size=batch_size,
    )
    shape = (size,) if ndim == 1 else (size // 3, 3)
    buffer.extend(TensorDict({"row": torch.arange(size).view(shape)}, shape))
    return buffer


def _epoch(buffer):
    return torch.cat([minibatch["row"] for minibatch in buffer])


@pytest.mark.parametrize("cls", [ReplayBuffer, TensorDictReplayBuffer])
def test_each_epoch_of_a_stock_buffer_covers_it_once_in_another_order(cls):
    buffer = _buffer(size=64, batch_size=16, cls=cls)
    epochs = [_epoch(buffer) for _ in range(4)]
    for epoch in epochs:
        assert torch.equal(epoch.sort().values, torch.arange(64))
    for one, other in itertools.combinations(epochs, 2):
        assert not torch.equal(one, other), "epochs must not reuse an order"


def test_stops_iterating_where_torchrls_sampler_does():
    reference = ReplayBuffer(
        storage=LazyTensorStorage(10),
        sampler=SamplerWithoutReplacement(shuffle=False),
        batch_size=4,
    )
    ours = _buffer(size=10, batch_size=4, shuffle=False)
    reference.extend(TensorDict({"row": torch.arange(10)}, [10]))
    for _ in range(2):
        one, other = (
            [minibatch["row"].tolist() for minibatch in buffer] for buffer in (reference, ours)
        )
        assert one == other == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]


def test_drop_last_leaves_out_the_smaller_minibatch():
    buffer = _buffer(size=10, batch_size=4, drop_last=True)
    assert [len(minibatch) for minibatch in buffer] == [4, 4]
    with pytest.raises(ValueError, match="batch_size=11.*10"):
        buffer.sample(11)


def test_storage_of_two_dims_is_covered_once():
    buffer = _buffer(size=12, batch_size=4, ndim=2)
    assert torch.equal(_epoch(buffer).sort().values, torch.arange(12))


def test_every_order_is_about_equally_likely():
    buffer = _buffer(size=4, batch_size=4)
    orders = [tuple(buffer.sample()["row"].tolist()) for _ in range(2400)]
    counts = [orders.count(order) for order in itertools.permutations(range(4))]
    chi_square = sum((count - 100) ** 2 / 100 for count in counts)
    assert chi_square < 49.7, (
        f"23 degrees of freedom: 49.7 is exceeded once in 1000, got {chi_square:.1f}"
    )


def test_seed_fixes_the_orders():
    one, same, other = _buffer(seed=1), _buffer(seed=1), _buffer(seed=2)
    first = _epoch(one)
    assert torch.equal(first, _epoch(same))
    assert not torch.equal(first, _epoch(other))
    second = _epoch(one)
    one.sampler.set_seed(1)
    assert torch.equal(first, _epoch(one))
    assert torch.equal(second, _epoch(one))


def test_shards_of_different_sizes_are_refused():
    with pytest.raises(ValueError, match="7 elements.*2 shards"):
        _buffer(size=7, batch_size=7, shards=2).sample()


@pytest.mark.parametrize("shuffle", [True, False])
@pytest.mark.parametrize("samples", [0, 1, 2, 3, 5])
def test_continues_exactly_from_integers(samples, shuffle):
    buffer, resumed = _buffer(seed=7, shuffle=shuffle), _buffer(seed=0, shuffle=shuffle)
    for _ in range(samples):
        buffer.sample()
    state = json.loads(json.dumps(buffer.sampler.state_dict()))
    assert all(type(value) is int for value in state.values())
    resumed.sampler.load_state_dict(state)
    for _ in range(7):
        assert torch.equal(buffer.sample()["row"], resumed.sample()["row"])


def test_dumps_and_loads_through_a_file(tmp_path):
    buffer, resumed = _buffer(seed=7), _buffer()
    buffer.sample()
    buffer.sampler.dumps(tmp_path / "sampler")
    resumed.sampler.loads(tmp_path / "sampler")
    assert torch.equal(buffer.sample()["row"], resumed.sample()["row"])


def test_new_data_starts_a_new_epoch():
    buffer = _buffer()
    buffer.sample()
    buffer.extend(TensorDict({"row": torch.arange(12)}, [12]))
    assert torch.equal(_epoch(buffer).sort().values, torch.arange(12))


def test_growing_storage_is_covered_once():
    buffer = ReplayBuffer(storage=LazyTensorStorage(12), sampler=EpochSampler(), batch_size=4)
    buffer.extend(TensorDict({"row": torch.arange(8)}, [8]))
    assert torch.equal(_epoch(buffer).sort().values, torch.arange(8))
    buffer.extend(TensorDict({"row": torch.arange(8, 12)}, [4]))
    assert torch.equal(_epoch(buffer).sort().values, torch.arange(12))


def test_no_host_sync():
    buffer = _buffer()
    with count_syncs() as syncs:
        for _ in range(7):
            buffer.sample()
    assert syncs.total == 0, syncs.report()


def test_an_empty_buffer_is_refused():
    buffer = ReplayBuffer(storage=LazyTensorStorage(12), sampler=EpochSampler(), batch_size=4)
    with pytest.raises(RuntimeError, match="empty"):
        buffer.sample()


@pytest.mark.parametrize("shards", [1, 3])
@pytest.mark.parametrize("shuffle", [True, False])
def test_orders_of_several_epochs_are_those_of_one_after_the_other(shards, shuffle):
    together, apart = (
        EpochSampler(seed=3, shards=shards, num_minibatches=4, shuffle=shuffle) for _ in range(2)
    )
    for count in (2, 3):
        orders_KD = together.epoch_orders(count, 24, device=torch.device("cpu"))
        singles = [apart.epoch_orders(1, 24, device=torch.device("cpu"))[0] for _ in range(count)]
        assert torch.equal(orders_KD, torch.stack(singles))
        assert together.state_dict() == apart.state_dict()
    buffer = _buffer(
        size=24, batch_size=6, seed=3, shards=shards, num_minibatches=4, shuffle=shuffle
    )
    drawn = [_epoch(buffer) for _ in range(2)]
    apart.set_seed(3)
    assert torch.equal(torch.stack(drawn), apart.epoch_orders(2, 24, device=torch.device("cpu")))
