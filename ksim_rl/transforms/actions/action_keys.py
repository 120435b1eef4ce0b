"""What transforms of actions share."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


def checked_action(
    tensordict: TensorDictBase, key: NestedKey, leaf: Sequence[int], dtype: torch.dtype
) -> Tensor:
    """Return the action, refused before it reaches a buffer: the env sees only what comes out of that.

    Raises:
        ValueError: with both shapes and dtypes.
    """
    action = tensordict.get(key)
    expected = (*tensordict.batch_size, *leaf)
    if tuple(action.shape) != expected or action.dtype != dtype:
        raise ValueError(
            f"action {key!r} has shape {tuple(action.shape)} and dtype {action.dtype}: expected {expected} and {dtype}"
        )
    return action
