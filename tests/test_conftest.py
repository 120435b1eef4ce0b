"""The shape annotations of ksim_rl are enforced while the tests run."""

import pytest
import torch
from jaxtyping import Float, TypeCheckError
from torch import Tensor

from tests.conftest import _checked


def _dot(a_EL: Float[Tensor, "E L"], b_EL: Float[Tensor, "E L"]) -> Float[Tensor, " E"]:
    return (a_EL * b_EL).sum(-1)


def _plain(value: int) -> int:
    return value


def test_a_wrong_shape_is_an_error():
    dot = _checked(_dot)
    assert dot(torch.ones(2, 3), torch.ones(2, 3)).tolist() == [3.0, 3.0]
    with pytest.raises(TypeCheckError):
        dot(torch.ones(2, 3), torch.ones(2, 4))
    with pytest.raises(TypeCheckError):
        dot(torch.ones(2, 3), torch.ones(2, 3, dtype=torch.int64))


def test_a_function_without_shapes_is_left_alone():
    assert _checked(_plain) is _plain
