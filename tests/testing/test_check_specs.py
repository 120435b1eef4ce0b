import pytest
import torch
from tensordict import TensorDict

from ksim_rl.testing import assert_dims, assert_leaf


def data(names):
    inner = TensorDict({"x": torch.zeros(2, 3, 5)}, batch_size=[2, 3])
    td = TensorDict({"x": torch.zeros(2, 3, 4), "inner": inner}, batch_size=[2, 3])
    td.names = names
    return td


def test_matching_names_pass():
    assert_dims(data(["E", "T"]), "E", "T")


@pytest.mark.parametrize("names", [["E"], ["T", "E"], ["E", "T", "L"], []])
def test_other_names_fail(names):
    with pytest.raises(AssertionError, match="expected"):
        assert_dims(data(["E", "T"]), *names)


def test_nested_names_are_checked():
    td = data(["E", "T"])
    td["inner"].names = ["D", "T"]
    with pytest.raises(AssertionError, match=r"\['inner'\]"):
        assert_dims(td, "E", "T")


def test_leaf_shapes():
    assert_leaf(data(["E", "T"]), ("inner", "x"), 5)
    with pytest.raises(AssertionError, match="expected"):
        assert_leaf(data(["E", "T"]), "x", 5)
