"""Types the context that autograd passes to functions with custom gradients."""

from typing import Protocol

from jaxtyping import Shaped
from torch import Tensor


class GradientContext(Protocol):
    """The part of autograd's context that the `forward` and `backward` of our `Function`s use."""

    saved_tensors: tuple[Tensor, ...]
    needs_input_grad: tuple[bool, ...]

    def save_for_backward(self, *tensors: Shaped[Tensor, "*?saved"] | None) -> None:
        """Keep tensors for `backward`, which finds them in `saved_tensors`."""

    def set_materialize_grads(self, value: bool) -> None:
        """Say whether `backward` gets zeros, and not None, for outputs that the loss does not depend on."""
