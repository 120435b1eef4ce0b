"""This module builds the perceptrons of actors and critics, and runs their layers in half precision on CUDA."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

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
    layers, width = nn.Sequential() if num_networks is None and not layer_norm else Layers(), input_dim
    for hidden_dim in hidden_dims:
        layers.append(layer(width, hidden_dim, gain=math.sqrt(2.0), device=device))
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
    """N linear layers as one batched product: [N, B, input_dim], or [1, B, input_dim] for all, to [N, B, output_dim].

    Weights are orthogonal with scale `gain`, drawn on the CPU network by network, and biases zero.
    """

    def __init__(
        self, num_networks: int, input_dim: int, output_dim: int, *, gain: float, device: Device = None
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

    def forward(self, features_NBL: Float[Tensor, "#N B L"]) -> Float[Tensor, "N B M"]:
        """Return what each layer gives for its own input."""
        return torch.baddbmm(self.bias, features_NBL.expand(len(self.weight), -1, -1), self.weight)


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
        return torch.addcmul(self.bias, functional.layer_norm(features_NBL, (self.dim,)), self.weight)


class Layers(nn.Sequential):
    """Linear layers, norms and activations in a row, which take [..., input_dim], or those of ensembles in a row.

    With autocast on CUDA products are in bfloat16, and a norm, the bias before it and the activation after it are one
    kernel, or a part of the product's. An activation that the kernels do not have follows them.
    """

    def forward(self, features: Float[Tensor, "#*batch L"]) -> Float[Tensor, "*batch M"]:
        """Return what the last layer gives."""
        if not rounds(features):
            return super().forward(features)
        # Not above: Triton comes with torch for CUDA only.
        from ksim_rl.modules.layer_kernels import FUSED, Layer, rounded_weights

        alone = not isinstance(self[0], EnsembleLinear)
        out = features.reshape(1, -1, features.shape[-1]) if alone else features
        parts: list[Any] = list(self)
        linears = [part for part in parts if isinstance(part, nn.Linear | EnsembleLinear)]
        weights = [layer.weight for layer in linears]
        rounded = rounded_weights([own.mT[None] if alone else own for own in weights])
        while parts:
            layer = parts.pop(0)
            if not isinstance(layer, nn.Linear | EnsembleLinear):
                out = layer(out)
                continue
            given = out, weights.pop(0), rounded.pop(0), torch.is_grad_enabled()
            if not parts or not isinstance(parts[0], nn.LayerNorm | EnsembleLayerNorm):
                out = Layer.apply(*given) + layer.bias.to(torch.bfloat16)
                continue
            norm = parts.pop(0)
            kind = type(parts[0]) if parts else None
            known = FUSED.index(kind) + 1 if kind in FUSED else 0
            out = Layer.apply(*given, layer.bias, norm.weight, norm.bias, known)
            del parts[: bool(known)]
        return out.reshape(*features.shape[:-1], -1) if alone else out


def rounds(features: Float[Tensor, "*batch L"]) -> bool:
    """Whether products of these are to be in bfloat16, on a device with kernels for what follows."""
    return features.is_cuda and torch.is_autocast_enabled("cuda")
