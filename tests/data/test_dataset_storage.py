import pytest
import torch
from tensordict import TensorDict

from ksim_rl.data import MASK_KEY, DatasetStorage
from ksim_rl.testing import count_syncs


def _rollout(*shape, **leaves):
    data = {
        "obs": torch.randn(*shape, 3),
        "image": torch.randn(*shape, 2, 2),
        ("nested", "reward"): torch.randn(*shape, 1),
        "log_prob": torch.randn(*shape),
        "step": torch.arange(torch.Size(shape).numel()).view(shape),
        "done": torch.rand(*shape, 1) < 0.5,
    }
    return TensorDict(data | leaves, shape)


def _content(storage):
    return storage.get(slice(None))


def test_flattens_env_major_whatever_the_memory():
    rollout = _rollout(4, 3)
    time_major = rollout.apply(lambda leaf: leaf.transpose(0, 1).contiguous().transpose(0, 1))
    for data in (rollout, time_major, rollout.reshape(-1)):
        storage = DatasetStorage(12)
        storage.write(data)
        content = _content(storage)
        assert len(storage) == 12
        for key, leaf in rollout.items(True, True):
            assert torch.equal(content[key], leaf.flatten(0, 1))
        assert content[MASK_KEY].all()
        assert content.names == ["D"]


def test_later_writes_keep_the_addresses():
    storage = DatasetStorage(12)
    storage.write(_rollout(4, 3))
    before = {key: leaf.data_ptr() for key, leaf in _content(storage).items(True, True)}
    second = _rollout(4, 3)
    with count_syncs() as syncs:
        storage.write(second)
    assert syncs.total == 0, syncs.report()
    assert before == {key: leaf.data_ptr() for key, leaf in _content(storage).items(True, True)}
    assert torch.equal(_content(storage)["obs"], second["obs"].flatten(0, 1))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_rows_that_are_not_finite_are_replaced_masked_and_counted(bad):
    rollout = _rollout(4, 3)
    clean = rollout.clone()
    rollout["obs"][0, 0, 1] = bad
    rollout["image"][1, 2, 0, 1] = bad
    rollout["nested", "reward"][1, 2] = bad
    rollout["log_prob"][3, 1] = bad
    removed = torch.zeros(4, 3, dtype=torch.bool)
    removed[0, 0] = removed[1, 2] = removed[3, 1] = True
    storage = DatasetStorage(12)
    storage.write(rollout)
    content = _content(storage)
    assert int(storage.non_finite_count) == 3
    assert torch.equal(content[MASK_KEY].flatten(), ~removed.flatten())
    for key, leaf in clean.items(True, True):
        kept = leaf.flatten(0, 1)
        assert torch.equal(content[key][~removed.flatten()], kept[~removed.flatten()])
        # Row 0 is removed, so row 1 is the first finite one. Flags stay.
        replaced = (
            kept[removed.flatten()] if leaf.dtype == torch.bool else kept[1:2].expand_as(kept[:3])
        )
        assert torch.equal(content[key][removed.flatten()], replaced)
    storage.write(clean)
    assert int(storage.non_finite_count) == 3
    assert _content(storage)[MASK_KEY].all()


def test_no_finite_row_at_all_gives_finite_masked_rows():
    rollout = _rollout(2, 2)
    rollout["obs"].fill_(float("nan"))
    storage = DatasetStorage(4)
    storage.write(rollout)
    content = _content(storage)
    assert not content[MASK_KEY].any()
    assert all(leaf.isfinite().all() for leaf in content.values(True, True))
    assert int(storage.non_finite_count) == 4


@pytest.mark.parametrize("trailing", [(), (1,)])
def test_a_mask_that_the_data_brings_is_kept(trailing):
    mask = torch.tensor([[False, True], [True, True]])
    rollout = _rollout(2, 2, **{})
    rollout[MASK_KEY] = mask.view(2, 2, *trailing)
    rollout["obs"][1, 1] = float("nan")
    storage = DatasetStorage(4)
    storage.write(rollout)
    content = _content(storage)
    assert content[MASK_KEY].flatten().tolist() == [False, True, True, False]
    assert torch.equal(content["obs"][0], rollout["obs"][0, 0]), (
        "a masked but finite row keeps its data"
    )
    assert torch.equal(content["obs"][3], rollout["obs"][0, 1]), (
        "the donor is a row that takes part"
    )
    assert int(storage.non_finite_count) == 1


def test_gradients_are_not_stored():
    rollout = _rollout(2, 2)
    rollout["obs"].requires_grad_()
    storage = DatasetStorage(4)
    storage.write(rollout)
    assert not _content(storage)["obs"].requires_grad


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data.exclude("obs"), "missing.*'obs'"),
        (lambda data: data.set("extra", torch.zeros(2, 2)), "new.*'extra'"),
        (lambda data: data.set("obs", torch.zeros(2, 2, 4)), r"'obs'.*\(4,\).*\(3,\)"),
        (lambda data: data.set("obs", torch.zeros(2, 2, 3).double()), "'obs'.*float64.*float32"),
        (lambda data: data[:, :1], r"4 env states.*has 2.*\(2, 1\)"),
    ],
)
def test_refusals_name_the_leaf_and_the_numbers(change, message):
    storage = DatasetStorage(4)
    storage.write(_rollout(2, 2))
    with pytest.raises(ValueError, match=message):
        storage.write(change(_rollout(2, 2)))


def test_data_without_numbers_to_learn_from_is_refused():
    with pytest.raises(ValueError, match="no floating-point leaf"):
        DatasetStorage(4).write(TensorDict({"step": torch.arange(4)}, [4]))
