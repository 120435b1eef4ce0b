"""This module builds the multi-layer perceptrons that actors and critics are made of."""

import math
from collections.abc import Callable, Sequence
from functools import partial

from torch import nn

from ksim_rl.checked import Count, check_value
from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.modules.layers import Device, EnsembleLayerNorm, EnsembleLinear, Layers

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
    layers, width = nn.Sequential() if num_networks is None and not layer_norm else Layers(), input_dim
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
