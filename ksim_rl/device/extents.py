"""Where tensors lie in memory, so that two of them can be asked whether they share some of it."""

from jaxtyping import Shaped
from torch import Tensor


def extent(tensor: Shaped[Tensor, "*shape"]) -> tuple[int, int]:
    """Return the address of a tensor's first number, and the one behind the last, of a tensor that is not empty.

    Numbers of others may lie in between, where the tensor is some columns of a table.
    """
    last = 0
    for size, stride in zip(tensor.shape, tensor.stride(), strict=True):
        last += (size - 1) * stride
    start = tensor.data_ptr()
    return start, start + (last + 1) * tensor.element_size()
