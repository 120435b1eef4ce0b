"""This module evaluates several networks of one shape at once."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from ksim_rl.modules.mlp import ACTIVATIONS, check_network


class EnsembleLinear(nn.Module):
    """N linear layers as one batched product: [N, B, input_dim] to [N, B, output_dim].

    Weights are orthogonal with scale `gain`, drawn on the CPU network by network, and biases zero.
    """

    def __init__(
        self,
        num_networks: int,
        input_dim: int,
        output_dim: int,
        *,
        gain: float,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        weight = torch.empty(num_networks, output_dim, input_dim)
        for network in weight:
            nn.init.orthogonal_(network, gain)
        self.weight = nn.Parameter(weight.transpose(1, 2).contiguous().to(device))
        self.bias = nn.Parameter(torch.zeros(num_networks, 1, output_dim, device=device))

    def forward(self, features_NBL: Float[Tensor, "N B L"]) -> Float[Tensor, "N B M"]:
        """Return what each layer gives for its own input."""
        return torch.baddbmm(self.bias, features_NBL, self.weight)


class EnsembleLayerNorm(nn.Module):
    """N layer norms (Ba et al., arXiv 1607.06450) of the last dim, each with its own scale and offset."""

    def __init__(self, num_networks: int, dim: int, *, device: torch.device | str | None = None) -> None:
        super().__init__()
        self.dim = dim
        self.weight = nn.Parameter(torch.ones(num_networks, 1, dim, device=device))
        self.bias = nn.Parameter(torch.zeros(num_networks, 1, dim, device=device))

    def forward(self, features_NBL: Float[Tensor, "N B L"]) -> Float[Tensor, "N B L"]:
        """Normalize the last dim, and apply each network's own scale and offset."""
        # Autocast would go on in float32 up to the next product, which moves twice the memory.
        with torch.autocast(features_NBL.device.type, enabled=False):
            normalized_NBL = functional.layer_norm(features_NBL, (self.dim,))
            weight, bias = (parameter.to(features_NBL.dtype) for parameter in (self.weight, self.bias))
            return torch.addcmul(bias, normalized_NBL, weight)


def ensemble_mlp(
    num_networks: int,
    input_dim: int,
    hidden_dims: Sequence[int],
    output_dim: int,
    *,
    activation: str = "silu",
    layer_norm: bool = False,
    output_gain: float = 1.0,
    device: torch.device | str | None = None,
) -> nn.Sequential:
    """Build N networks as `mlp` builds one: a module from [N, B, input_dim] to [N, B, output_dim].

    Args:
        layer_norm: normalize before each activation, which keeps the values of actions that were never tried from
            growing without bound (Ball et al., "Efficient online reinforcement learning with offline data", 2023).
    """
    check_network(hidden_dims, activation)
    layers, width = nn.Sequential(), input_dim
    for hidden_dim in hidden_dims:
        layers.append(EnsembleLinear(num_networks, width, hidden_dim, gain=math.sqrt(2.0), device=device))
        if layer_norm:
            layers.append(EnsembleLayerNorm(num_networks, hidden_dim, device=device))
        layers.append(ACTIVATIONS[activation]())
        width = hidden_dim
    return layers.append(EnsembleLinear(num_networks, width, output_dim, gain=output_gain, device=device))
