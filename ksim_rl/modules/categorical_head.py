"""This module has the last layer of a policy that chooses."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ksim_rl.modules.categorical import Categorical
from ksim_rl.modules.mlp import linear


class CategoricalHead(nn.Module):
    """Maps features [..., L] to the `logits` [..., N] of a `Categorical`.

    Args:
        feature_dim: L.
        num_options: N, of all choices together.
        sizes, one_hot, dtype: of the `Categorical`.
        output_gain: scale of the layer's orthogonal weights; with a small one all options start alike.
    """

    parameter_names = ("logits",)

    def __init__(
        self,
        feature_dim: int,
        num_options: int,
        *,
        sizes: Sequence[int] | None,
        one_hot: bool,
        dtype: torch.dtype,
        output_gain: float,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.logits = linear(feature_dim, num_options, gain=output_gain, device=device)
        self.sizes, self.one_hot, self.dtype = sizes, one_hot, dtype

    def forward(self, features: Float[Tensor, "*batch L"]) -> tuple[Float[Tensor, "*batch N"]]:
        """Return `(logits,)`."""
        return (self.logits(features),)

    def distribution(self, logits: Float[Tensor, "*batch N"]) -> Categorical:
        """Return the distribution of the choices."""
        return Categorical(logits, self.sizes, self.one_hot, self.dtype)
