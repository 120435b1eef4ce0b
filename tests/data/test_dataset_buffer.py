import pytest
import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement, Writer
from torchrl.data.replay_buffers.storages import TensorStorage
from torchrl.envs.transforms import DoubleToFloat

from ksim_rl import dims
from ksim_rl.data import DatasetBuffer, DatasetCfg
from ksim_rl.testing import count_syncs

CFG = DatasetCfg(num_env_states_per_minibatch=6, num_minibatches=4)


def _rollout(num_envs=8, length=3):
    shape = (num_envs, length)
    data = TensorDict(
        {
            "obs": torch.randn(*shape, 3),
            "row": torch.arange(num_envs * length).view(shape),
            "next": {"obs": torch.randn(*shape, 3)},
        },
        shape,
    )
    return dims.name(data, dims.E, dims.T)


def test_is_a_replay_buffer_of_torchrl_parts():
    dataset = DatasetBuffer(CFG)
    assert isinstance(dataset, ReplayBuffer)
    assert isinstance(dataset.storage, TensorStorage)
    assert isinstance(dataset.writer, Writer)
    assert dataset.batch_size == 6


def test_shapes_and_names_of_dataset_and_minibatch():
    dataset, rollout = DatasetBuffer(CFG), _rollout()
    index = dataset.extend(rollout)
    assert torch.equal(index, torch.arange(24))
    assert dataset.all().batch_size == (24,)
    assert dataset.all().names == [dims.D]
    minibatch = dataset.sample()
    assert minibatch.batch_size == (6,)
    assert minibatch.names == [dims.B]
    minibatch, info = dataset.sample(return_info=True)
    assert torch.equal(minibatch["row"], info["index"])
    assert rollout.names == [dims.E, dims.T], "the rollout is left as it was"


def test_rows_stay_together():
    dataset, rollout = DatasetBuffer(CFG), _rollout()
    dataset.extend(rollout)
    flat = rollout.reshape(-1)
    for minibatch in dataset.epoch():
        assert torch.equal(minibatch["obs"], flat["obs"][minibatch["row"]])
        assert torch.equal(minibatch["next", "obs"], flat["next", "obs"][minibatch["row"]])


def test_every_epoch_covers_the_dataset_exactly_once():
    dataset = DatasetBuffer(CFG)
    dataset.extend(_rollout())
    orders = []
    for _ in range(3):
        minibatches = list(dataset.epoch())
        assert [minibatch.names for minibatch in minibatches] == [[dims.B]] * 4
        orders.append(torch.cat([minibatch["row"] for minibatch in minibatches]))
        assert torch.equal(orders[-1].sort().values, torch.arange(24))
    assert not torch.equal(orders[0], orders[1])


def test_epoch_sample_and_iteration_read_the_same_order():
    orders = []
    for read in (
        lambda dataset: list(dataset.epoch()),
        lambda dataset: [dataset.sample() for _ in range(4)],
        list,
    ):
        dataset = DatasetBuffer(CFG, seed=3)
        dataset.extend(_rollout())
        orders.append(torch.cat([minibatch["row"] for minibatch in read(dataset)]))
    assert torch.equal(orders[0], orders[1])
    assert torch.equal(orders[0], orders[2])


def test_epoch_starts_anew_after_a_broken_off_one():
    dataset = DatasetBuffer(CFG)
    dataset.extend(_rollout())
    dataset.sample()
    next(dataset.epoch())
    rows = torch.cat([minibatch["row"] for minibatch in dataset.epoch()])
    assert torch.equal(rows.sort().values, torch.arange(24))


def test_num_envs_does_not_matter_to_the_dataset():
    for num_envs, length in ((24, 1), (8, 3), (1, 24)):
        dataset = DatasetBuffer(CFG)
        dataset.extend(_rollout(num_envs, length))
        assert torch.equal(dataset.all()["row"], torch.arange(24))


def test_keys_select_what_is_stored():
    dataset = DatasetBuffer(CFG, keys=["obs", ("next", "obs")])
    dataset.extend(_rollout())
    assert set(dataset.all().keys(True, True)) == {"obs", ("next", "obs"), ("collector", "mask")}
    with pytest.raises(ValueError, match="lacks.*'obs'.*row"):
        DatasetBuffer(CFG, keys=["obs"]).extend(_rollout().exclude("obs"))


def test_only_stored_leaves_decide_what_is_removed():
    rollout = _rollout()
    rollout["next", "obs"][0, 0] = float("nan")
    dataset = DatasetBuffer(CFG, keys=["obs"])
    dataset.extend(rollout)
    assert int(dataset.non_finite_count) == 0
    everything = DatasetBuffer(CFG)
    everything.extend(rollout)
    assert int(everything.non_finite_count) == 1


@pytest.mark.parametrize("shape", [(8, 2), (8, 4), (24, 2)])
def test_wrong_size_is_refused_with_the_numbers(shape):
    size = shape[0] * shape[1]
    with pytest.raises(ValueError, match=rf"{size} env states.*=6 \* num_minibatches=4 = 24"):
        DatasetBuffer(CFG).extend(_rollout(*shape))


def test_single_env_states_are_refused():
    with pytest.raises(ValueError, match="as a whole"):
        DatasetBuffer(CFG).add(_rollout()[0, 0])


def test_update_of_whole_epochs_makes_no_host_sync():
    dataset, rollout = DatasetBuffer(CFG), _rollout()
    with count_syncs() as syncs:
        for _ in range(2):
            dataset.extend(rollout)
            for _ in range(2):
                for minibatch in dataset.epoch():
                    minibatch["obs"].sum()
            dataset.sample()
    assert syncs.total == 0, syncs.report()


def test_other_samplers_and_transforms_of_torchrl_work():
    dataset = DatasetBuffer(CFG, sampler=SamplerWithoutReplacement())
    dataset.append_transform(DoubleToFloat(in_keys=["double"]))
    rollout = _rollout()
    dataset.extend(rollout.set("double", torch.randn(8, 3, 2).double()))
    minibatches = list(dataset.epoch())
    assert torch.equal(torch.cat([m["row"] for m in minibatches]).sort().values, torch.arange(24))
    assert {m["double"].dtype for m in minibatches} == {torch.float32}


@pytest.mark.parametrize("fresh", [True, False])
def test_state_dict_continues_exactly(fresh):
    rollout = _rollout()
    rollout["obs"][0, 0] = float("nan")
    dataset, resumed = DatasetBuffer(CFG, seed=4), DatasetBuffer(CFG)
    dataset.extend(rollout)
    dataset.sample()
    if not fresh:
        resumed.extend(_rollout())
    resumed.load_state_dict(dataset.state_dict())
    assert int(resumed.non_finite_count) == 1
    for _ in range(9):
        assert (dataset.sample() == resumed.sample()).all()
    resumed.extend(rollout)
    assert int(resumed.non_finite_count) == 2


@pytest.mark.parametrize(("num_envs", "size"), [(4096, 24576), (16, 96)])
def test_the_size_follows_from_a_rollout_length(num_envs, size):
    cfg = DatasetCfg(num_env_states_per_minibatch=7, num_minibatches=4).with_rollout_length(
        24, num_envs
    )
    assert (cfg.num_env_states_per_minibatch, cfg.rollout_length(num_envs)) == (size, 24)


def test_a_rollout_length_that_does_not_split_is_refused_with_those_that_do():
    with pytest.raises(
        ValueError, match=r"rollout_length=7 \* num_envs=6 = 42 .*rollout_length=6 or 8 are"
    ):
        DatasetCfg(num_env_states_per_minibatch=7, num_minibatches=4).with_rollout_length(7, 6)
