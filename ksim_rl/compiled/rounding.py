"""Shows the effect of rounding on a result: it moves computed numbers by units in the last place.

A result may be far more sensitive than its size tells: 1 + cos(x) near pi keeps only the last bits of the cosine,
which another library may round otherwise. This is the random arithmetic of Vignes, "A stochastic arithmetic for
reliable scientific computation" (1993), for torch's operators.
"""

from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Shaped
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import PyTree, tree_map_only

from ksim_rl.device.recording import OpArgs, OpKwargs, OpOverload

_NAMES = """
    _softmax acos acosh add addcdiv addcmul addmm addmv asin asinh atan atan2 atanh baddbmm bmm cos cosh cumprod cumsum
    div dot erf erfc erfinv exp exp2 expm1 fmod frac gelu hypot lerp linalg_cross linalg_vector_norm log log10 log1p
    log2 logaddexp logsumexp mean mm mul mv norm pow prod reciprocal remainder rsqrt rsub sigmoid silu sin sinc sinh
    softplus sqrt square std sub sum tan tanh var xlogy
"""
ROUNDED = frozenset(_NAMES.split())
"""Operators whose results are rounded; others move numbers, compare them, or choose among them."""


def nudged(
    value: Shaped[Tensor, "*shape"], generator: torch.Generator, *, units: int = 1
) -> Shaped[Tensor, "*shape"]:
    """Return a copy with each floating-point number moved by `units` in the last place, up or down at random."""
    if not value.is_floating_point():
        return value
    # Drawn where the generator lives, which is where most of the numbers are: millions of draws take long elsewhere.
    draws = torch.randint(
        2, value.shape, generator=generator, device=generator.device, dtype=torch.int8
    )
    is_up = draws.to(value.device).bool()
    towards = torch.where(is_up, torch.inf, -torch.inf).to(value.dtype)
    # A difference of neighbours is exact, and so is its product with a power of two.
    unit = torch.nextafter(value, towards) - value
    return torch.where(value.isfinite(), value + units * unit, value)


class Nudging(TorchDispatchMode):
    """Moves, within this context, each number that an operator of torch rounds, by `units` in the last place.

    `generator` draws the directions.
    """

    def __init__(self, generator: torch.Generator, *, units: int = 1) -> None:
        super().__init__()
        self._moved = partial(nudged, generator=generator, units=units)

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: Sequence[type],
        args: OpArgs = (),
        kwargs: OpKwargs | None = None,
    ) -> PyTree:
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        # `add_` is rounded as `add` is; `_softmax` has its underscore in front.
        if name.rstrip("_") not in ROUNDED and name not in ROUNDED:
            return result
        if name.endswith("_"):
            # In place: views of the tensor must see the moved numbers.
            args[0].copy_(self._moved(args[0]))
            return result
        return tree_map_only(Tensor, self._moved, result)
