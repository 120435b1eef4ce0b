"""The letters of the batch dims, and the one function that labels them.

`E` envs, `T` time in the rollout, `D` dataset, `B` minibatch. `L` (the last, non-batch dim of a leaf) is a spelling
convention of variable names only: tensordict names batch dims, not leaf dims. So are `H`, `W` and `C`, the rows,
columns and channels of a picture, which stand where a vector has `L`: `rgb_EHWC`, uint8, whose first row is the top.

Names are labels that are set at boundaries (env output, rollout, dataset, minibatch). They are never computed with
inside compiled code, where tensordict drops them.
"""

from typing import TypeVar

from tensordict import TensorDictBase

E = "E"
T = "T"
D = "D"
B = "B"

AnyTensorDict = TypeVar("AnyTensorDict", bound=TensorDictBase)


def name(td: AnyTensorDict, *dims: str) -> AnyTensorDict:
    """Label the batch dims of `td`, in place, and return it.

    Nested tensordicts take the same labels for the batch dims that they share. A ValueError if the number of labels
    differs from the number of batch dims.
    """
    if len(dims) != td.batch_dims:
        raise ValueError(
            f"dims {dims} name {len(dims)} batch dims, but the tensordict has {td.batch_dims}: "
            f"batch_size {tuple(td.batch_size)}"
        )
    td.names = list(dims)
    return td
