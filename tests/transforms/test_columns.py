"""Values side by side: equal to concatenation always, and without a copy where they are neighbours already."""

import pytest
import torch
from tensordict import TensorDict

from ksim_rl.transforms import ObservationGroups
from ksim_rl.transforms.columns import side_by_side, split

WHOLE = torch.arange(24.0).reshape(4, 6)


def shared(values):
    return side_by_side(values, 4).data_ptr() == WHOLE.data_ptr()


def test_what_was_split_is_joined_without_a_copy():
    parts = split(WHOLE, [torch.empty(4, 2), torch.empty(4, 3, 1), torch.empty(4)])
    assert [part.shape for part in parts] == [(4, 2), (4, 3, 1), (4,)]
    assert torch.equal(side_by_side(parts, 4), WHOLE)
    assert shared([WHOLE[:, :2], WHOLE[:, 2:]]) and shared(
        [WHOLE[:, :1], WHOLE[:, 1:5], WHOLE[:, 5:]]
    )


@pytest.mark.parametrize(
    "values",
    [
        [WHOLE[:, 2:], WHOLE[:, :2]],
        [WHOLE[:, :2], WHOLE[:, 3:]],
        [WHOLE[:, :2], WHOLE[:, 2:5]],
        [WHOLE[:, :2], WHOLE[:, :2], WHOLE[:, 2:4]],
        [WHOLE[:, :2], WHOLE[:, 2:].clone()],
        [WHOLE[:, :2].clone(), WHOLE[:, 2:]],
        [WHOLE.T[:4, :3], WHOLE.T[:4, 3:]],
        [WHOLE[:, :2], WHOLE[:, 2:].long()],
    ],
    ids=["order", "gap", "missing", "twice", "copied", "first_copied", "transposed", "dtype"],
)
def test_all_others_are_concatenated(values):
    joined = side_by_side(values, 4)
    assert torch.equal(joined, torch.cat(values, 1)) and not shared(values)


def test_only_groups_that_own_their_terms_take_them_as_they_lie():
    terms = {"a": WHOLE[:, :2], "b": WHOLE[:, 2:]}

    def vector(groups, drop):
        return ObservationGroups(groups, drop=drop)(TensorDict(terms, batch_size=4))["g"]

    assert vector({"g": ["a", "b"]}, True).data_ptr() == WHOLE.data_ptr()
    for groups, drop in (({"g": ["a", "b"]}, ["a"]), ({"g": ["a", "b"], "h": ["b"]}, True)):
        kept = vector(groups, drop)
        assert torch.equal(kept, WHOLE) and kept.data_ptr() != WHOLE.data_ptr()
