"""Copies of rows."""

import pytest
import torch

from ksim_rl.device.copying import copy_rows


def test_columns_and_whole_rows_are_copied():
    wide_EL = torch.randn(5, 7)
    given = [wide_EL, wide_EL[:, 2:4], wide_EL[:, 3] > 0, wide_EL[:, :0]]
    to = [torch.zeros(2, *new.shape, dtype=new.dtype) for new in given]
    copy_rows([kept[1] for kept in to], given)
    for kept, new in zip(to, given, strict=True):
        assert torch.equal(kept[1], new) and not kept[0].any()
    copy_rows([], [])


def test_another_shape_or_type_is_not_broadcast():
    with pytest.raises(AssertionError, match="changes nothing"):
        copy_rows([torch.zeros(3, 2)], [torch.zeros(3, 1)])
    with pytest.raises(AssertionError, match="changes nothing"):
        copy_rows([torch.zeros(3, 2)], [torch.zeros(3, 2, dtype=torch.float64)])
