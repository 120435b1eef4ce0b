"""`SequenceSampler`: contiguous steps of one env, each once per epoch, in TorchRL's buffers and in ours."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ksim_rl.data import BURN_IN_KEY, MASK_KEY, DatasetBuffer, DatasetCfg, SequenceSampler
from ksim_rl.testing import count_syncs

E, T = 6, 12


def rollout():
    """Each env state knows its env and its step."""
    env_ET, step_ET = torch.meshgrid(torch.arange(E), torch.arange(T), indexing="ij")
    leaves = {"env": env_ET[..., None], "step": step_ET[..., None], "obs": torch.randn(E, T, 3)}
    return TensorDict(leaves, batch_size=[E, T], names=["E", "T"])


def ours(*, burn_in=0, length=4, seed=0):
    cfg = DatasetCfg(num_env_states_per_minibatch=24, num_minibatches=3)
    dataset = DatasetBuffer(
        cfg, sampler=SequenceSampler(sequence_length=length, burn_in=burn_in, seed=seed)
    )
    dataset.extend(rollout())
    return lambda: list(dataset.epoch())


def stock(*, burn_in=0, length=4, seed=0):
    sampler = SequenceSampler(sequence_length=length, burn_in=burn_in, seed=seed)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(E * T, ndim=2), sampler=sampler, batch_size=24
    )
    buffer.extend(rollout())
    return lambda: list(buffer)


def states(minibatches):
    """Return (env, step) of each env state, in order."""
    both = torch.cat([torch.cat([mb["env"], mb["step"]], -1).flatten(0, -2) for mb in minibatches])
    return [tuple(pair) for pair in both.tolist()]


@pytest.mark.parametrize("make", [ours, stock])
@pytest.mark.parametrize("length", [4, 12, 1])
def test_an_epoch_has_each_env_state_once_in_contiguous_sequences(make, length):
    epoch = make(length=length)
    orders = []
    for _ in range(3):
        minibatches = epoch()
        assert [tuple(mb.batch_size) for mb in minibatches] == [(24 // length, length)] * 3
        for minibatch_BT in minibatches:
            assert (minibatch_BT["env"] == minibatch_BT["env"][:, :1]).all()
            assert (minibatch_BT["step"].diff(dim=1) == 1).all()
        seen = states(minibatches)
        assert sorted(seen) == [(env, step) for env in range(E) for step in range(T)]
        orders.append(seen)
    assert orders[0] != orders[1] != orders[2] != orders[0]


def test_a_minibatch_of_ours_is_labelled_and_whole_rollouts_are_the_default():
    minibatch_BT = ours(length=None)()[0]
    assert minibatch_BT.names == ["B", "T"] and minibatch_BT.batch_size == (2, T)
    assert (minibatch_BT["step"][..., 0] == torch.arange(T)).all()


@pytest.mark.parametrize("make", [ours, stock])
def test_burn_in_comes_before_each_sequence_but_the_first_and_is_masked(make):
    minibatches = make(burn_in=3)()
    learned = []
    for minibatch_BT in minibatches:
        assert minibatch_BT.batch_size == (6, 7)
        mask_BT, burn_in_BT = minibatch_BT[MASK_KEY][..., 0], minibatch_BT[BURN_IN_KEY][..., 0]
        assert (mask_BT == (torch.arange(7) >= 3)).all()
        for env_T, step_T, burn_in_T in zip(
            minibatch_BT["env"][..., 0], minibatch_BT["step"][..., 0], burn_in_BT, strict=True
        ):
            assert (env_T == env_T[0]).all()
            start = int(step_T[3])
            assert step_T[3:].tolist() == [start, start + 1, start + 2, start + 3]
            before = [start - 3, start - 2, start - 1] if start else [0, 0, 0]
            assert step_T[:3].tolist() == before
            assert burn_in_T.tolist() == [start > 0] * 3 + [False] * 4
        learned.append(minibatch_BT[:, 3:])
    assert sorted(states(learned)) == [(env, step) for env in range(E) for step in range(T)]


def test_a_masked_env_state_stays_masked_beside_burn_in():
    cfg = DatasetCfg(num_env_states_per_minibatch=24, num_minibatches=3)
    dataset = DatasetBuffer(cfg, sampler=SequenceSampler(sequence_length=4, burn_in=2))
    data = rollout()
    data["obs"][2, 5] = torch.nan
    dataset.extend(data)
    # Another row's leaves stand in its place; the mask of one sequence, past the burn-in, shows it.
    masked = sum(int((~minibatch_BT[MASK_KEY][:, 2:]).sum()) for minibatch_BT in dataset.epoch())
    assert masked == 1


def test_where_episodes_begin_outlives_a_removed_env_state():
    cfg = DatasetCfg(num_env_states_per_minibatch=24, num_minibatches=3)
    dataset = DatasetBuffer(cfg, sampler=SequenceSampler(shuffle=False))
    data = rollout()
    data["is_init"] = data["step"] % 5 == 0
    data["obs"][2, 5] = torch.nan
    dataset.extend(data)
    stored = torch.cat([minibatch_BT["is_init"] for minibatch_BT in dataset.epoch()])
    assert torch.equal(stored, data["is_init"])


def test_no_host_sync():
    epoch = ours(burn_in=2)
    epoch()
    with count_syncs() as syncs:
        epoch()
    assert syncs.total == 0, syncs.report()


def test_orders_continue_from_a_state_dict_and_another_seed_gives_others():
    one, other = (
        SequenceSampler(sequence_length=4, seed=3),
        SequenceSampler(sequence_length=4, seed=9),
    )
    storage = LazyTensorStorage(E * T, ndim=2)
    storage.set(torch.arange(T), rollout().transpose(0, 1).contiguous())
    draw = [one.sample(storage, 24)[0] for _ in range(4)][-1]
    assert not all(
        torch.equal(a, b) for a, b in zip(draw, other.sample(storage, 24)[0], strict=True)
    )
    other.load_state_dict(one.state_dict())
    for _ in range(5):
        drawn, expected = other.sample(storage, 24)[0], one.sample(storage, 24)[0]
        assert all(torch.equal(a, b) for a, b in zip(drawn, expected, strict=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length": 5}, "sequence_length=5: rollouts have 12 steps"),
        ({"length": 4, "burn_in": 5}, "burn_in=5 is longer than sequence_length=4"),
    ],
)
@pytest.mark.parametrize("make", [ours, stock])
def test_sizes_that_do_not_fit_are_refused_with_the_numbers(make, options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)()


def test_a_minibatch_that_is_no_whole_number_of_sequences_is_refused_with_the_numbers():
    cfg = DatasetCfg(num_env_states_per_minibatch=18, num_minibatches=4)
    dataset = DatasetBuffer(cfg, sampler=SequenceSampler(sequence_length=4))
    with pytest.raises(
        ValueError,
        match=r"sequence_length=4: num_env_states_per_minibatch=18 is no whole number .* \(4.5\)",
    ):
        dataset.extend(rollout())


def test_a_storage_of_one_dim_needs_the_rollout_length():
    storage = LazyTensorStorage(E * T)
    storage.set(torch.arange(E * T), rollout().flatten())
    with pytest.raises(ValueError, match="pass rollout_length"):
        SequenceSampler(sequence_length=4).sample(storage, 24)
    index, info = SequenceSampler(sequence_length=4, rollout_length=T).sample(storage, 24)
    assert index.shape == (6, 4) and info == {}
    with pytest.raises(ValueError, match="no whole number of rollouts of 10 steps"):
        SequenceSampler(sequence_length=5, rollout_length=10).sample(storage, 20)
