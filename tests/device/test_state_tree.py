"""Nested state, taken apart and put together."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ksim_rl.device import state_tree

plain = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
trees = st.recursive(
    plain | st.lists(plain, max_size=3),
    lambda children: st.dictionaries(st.text(max_size=4), children, max_size=3),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(st.text(max_size=4), trees, max_size=4))
def test_plain_trees_come_back_whatever_their_keys(tree):
    assert state_tree.join(*state_tree.split(tree)) == tree


def test_tensors_are_copied_to_the_host_and_keep_dtype_and_shape():
    live = torch.arange(6).reshape(2, 3).t()
    tensors, values = state_tree.split({"a": {"b/c": live}})
    live.zero_()
    assert values == {}
    assert tensors["/a/b~1c"].tolist() == [[0, 3], [1, 4], [2, 5]]
    assert tensors["/a/b~1c"].is_contiguous()


def test_copy_into_keeps_addresses():
    live = {"weight": torch.zeros(3)}
    address = live["weight"].data_ptr()
    state_tree.copy_into(live, {"weight": torch.ones(3)}, what="actor")
    assert live["weight"].tolist() == [1.0, 1.0, 1.0]
    assert live["weight"].data_ptr() == address


@pytest.mark.parametrize(
    ("saved", "message"),
    [
        ({}, "actor: the checkpoint has no 'weight'"),
        ({"weight": torch.zeros(3), "more": torch.zeros(1)}, "'more' is unknown to this run"),
        (
            {"weight": torch.zeros(4)},
            r"'weight' is float32\[4\] in the checkpoint and float32\[3\] in this run",
        ),
        ({"weight": torch.zeros(3).double()}, r"float64\[3\] in the checkpoint"),
        ({"weight": 1.0}, "'weight' is float in the checkpoint"),
    ],
)
def test_what_does_not_fit_is_named_and_nothing_is_copied(saved, message):
    live = {"weight": torch.full((3,), 5.0)}
    with pytest.raises(ValueError, match=message):
        state_tree.copy_into(live, saved, what="actor")
    assert live["weight"].tolist() == [5.0] * 3


@pytest.mark.parametrize(
    ("read", "expected"),
    [
        (state_tree.branch, "a mapping"),
        (state_tree.tensor, "a tensor"),
        (state_tree.number, "a number"),
        (state_tree.text, "a text"),
    ],
)
def test_a_reader_takes_one_kind_and_names_another_one(read, expected):
    state = {"a mapping": {"x": 1}, "a tensor": torch.ones(2), "a number": 3, "a text": "four"}
    assert read(state, expected) is state[expected]
    for other in {*state} - {expected}:
        with pytest.raises(ValueError, match=f"the state's '{other}' is .*: expected {expected}"):
            read(state, other)
    with pytest.raises(ValueError, match="'flag' is bool"):
        read({"flag": True}, "flag")
