"""This module builds the multi-layer perceptrons that actors and critics are made of."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from ksim_rl.checked import Count, check_value
from ksim_rl.checks import check_choice, check_in_range

Device = torch.device | str | None
ACTIVATIONS: dict[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "leaky_relu": nn.LeakyReLU,
    "mish": nn.Mish,
    "relu": nn.ReLU,
    "selu": nn.SELU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}


def mlp(
    input_dim: int,
    hidden_dims: Sequence[int],
    output_dim: int | None,
    *,
    activation: str = "elu",
    layer_norm: bool = False,
    hidden_gain: float = math.sqrt(2.0),
    output_gain: float = 1.0,
    num_networks: int | None = None,
    device: Device = None,
) -> nn.Sequential:
    """Build Linear layers with activations between them; the last one is linear, or left out for `output_dim=None`.

    Weights are orthogonal and biases zero: with such weights the scale of the signal does not depend on width or depth,
    and `output_gain` alone sets the scale of the first outputs (Andrychowicz et al., "What matters in on-policy
    reinforcement learning?", 2021: the gain of the last policy layer matters most, and should be small). `layer_norm`
    normalizes before each activation, which keeps the values of actions that were never tried from growing without
    bound (Ball et al., "Efficient online reinforcement learning with offline data", 2023). N networks of this shape at
    once map [N, B, input_dim] to [N, B, output_dim].
    """
    check_value("hidden_dims", hidden_dims, Sequence[Count])
    check_choice("activation", activation, ACTIVATIONS)
    check_in_range("output_gain", output_gain, low=0.0)
    layer: Callable[..., nn.Module] = linear
    norm: Callable[..., nn.Module] = nn.LayerNorm
    if num_networks is not None:
        layer, norm = partial(EnsembleLinear, num_networks), partial(EnsembleLayerNorm, num_networks)
    layers, width = nn.Sequential(), input_dim
    for hidden_dim in hidden_dims:
        layers.append(layer(width, hidden_dim, gain=hidden_gain, device=device))
        if layer_norm:
            layers.append(norm(hidden_dim, device=device))
        layers.append(ACTIVATIONS[activation]())
        width = hidden_dim
    if output_dim is not None:
        layers.append(layer(width, output_dim, gain=output_gain, device=device))
    return layers


def linear(input_dim: int, output_dim: int, *, gain: float, device: Device = None) -> nn.Linear:
    """Build one layer with orthogonal weights of scale `gain` and zero bias."""
    # Drawn on the CPU, so that one seed gives the same network on every device.
    layer = nn.Linear(input_dim, output_dim)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer.to(device)


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
        device: Device = None,
    ) -> None:
        super().__init__()
        self.gain = gain
        self.weight = nn.Parameter(torch.empty(num_networks, input_dim, output_dim, device=device))
        self.bias = nn.Parameter(torch.empty(num_networks, 1, output_dim, device=device))
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw the weights anew."""
        for network in self.weight:
            network.copy_(nn.init.orthogonal_(torch.empty(network.shape[::-1]), self.gain).t())
        self.bias.zero_()

    def forward(self, features_NBL: Float[Tensor, "N B L"]) -> Float[Tensor, "N B M"]:
        """Return what each layer gives for its own input."""
        if not torch.is_autocast_enabled(features_NBL.device.type):
            return torch.baddbmm(self.bias, features_NBL, self.weight)
        # Tensor cores are fast with rows of whole 16 bytes: 315 inputs take three times as long as 320.
        in_dim, out_dim = self.weight.shape[1:]
        weight = functional.pad(self.weight, (0, -out_dim % 8, 0, -in_dim % 8))
        out_NBM = torch.bmm(functional.pad(features_NBL, (0, -in_dim % 8)), weight)[..., :out_dim]
        return out_NBM + self.bias.to(out_NBM.dtype)


class EnsembleLayerNorm(nn.Module):
    """N layer norms (Ba et al., arXiv 1607.06450) of the last dim, each with its own scale and offset."""

    def __init__(self, num_networks: int, dim: int, *, device: Device = None) -> None:
        super().__init__()
        self.dim = dim
        self.weight = nn.Parameter(torch.ones(num_networks, 1, dim, device=device))
        self.bias = nn.Parameter(torch.zeros(num_networks, 1, dim, device=device))

    def reset_parameters(self) -> None:
        """Scale by one, and add nothing."""
        nn.init.ones_(self.weight)
        nn.init.zeros_(self.bias)

    def forward(self, features_NBL: Float[Tensor, "N B L"]) -> Float[Tensor, "N B L"]:
        """Normalize the last dim, and apply each network's own scale and offset."""
        # Autocast would go on in float32 up to the next product, which moves twice the memory.
        with torch.autocast(features_NBL.device.type, enabled=False):
            normalized_NBL = functional.layer_norm(features_NBL, (self.dim,))
            weight, bias = (parameter.to(features_NBL.dtype) for parameter in (self.weight, self.bias))
            return torch.addcmul(bias, normalized_NBL, weight)
