"""This module has the network that tells the transitions of a motion from those of a policy."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from ksim_rl.modules.mlp import Device, mlp
from ksim_rl.modules.network import ObservationNormalizer


class Discriminator(nn.Module):
    """Scores transitions [..., 2, L], the features before and after a step: 1 looks like the motions, -1 does not.

    Attributes:
        normalizer: of the features; both states of a transition are normalized alike.
        layers: the MLP, from normalized transitions [..., 2 L] to a score [..., 1].
    """

    def __init__(
        self,
        dim: int,
        *,
        hidden_dims: Sequence[int] = (512, 256),
        activation: str = "relu",
        device: Device = None,
    ) -> None:
        super().__init__()
        self.normalizer = ObservationNormalizer(dim, device=device)
        self.layers = mlp(2 * dim, hidden_dims, 1, activation=activation, device=device)

    @property
    def logit_weight_1L(self) -> Float[Tensor, "1 L"]:
        """The weights of the last layer."""
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        return last.weight

    def normalized(self, transition: Float[Tensor, "*batch 2 L"]) -> Float[Tensor, "*batch L+L"]:
        """Return what the layers read of transitions."""
        return self.normalizer(transition).flatten(-2)

    def judge(self, normalized: Float[Tensor, "*batch L"]) -> Float[Tensor, "*batch"]:
        """Return the scores of normalized transitions."""
        return self.layers(normalized).squeeze(-1)

    def forward(self, transition: Float[Tensor, "*batch 2 L"]) -> Float[Tensor, "*batch"]:
        """Return the scores of transitions."""
        return self.judge(self.normalized(transition))
