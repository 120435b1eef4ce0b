"""This module builds the multi-layer perceptron that actors and critics are made of."""

import math
from collections.abc import Sequence

import torch
from torch import nn

from ksim_rl.checks import check_choice, check_in_range

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


def check_network(hidden_dims: Sequence[int], activation: str) -> None:
    """Refuse layer widths that are no positive ints, and activations that do not exist.

    Raises:
        ValueError: naming the field, the value and what would be valid.
    """
    for index, width in enumerate(hidden_dims):
        if isinstance(width, bool) or not isinstance(width, int) or width < 1:
            raise ValueError(f"hidden_dims[{index}]={width!r}: expected a whole number >= 1")
    check_choice("activation", activation, ACTIVATIONS)


def mlp(
    input_dim: int,
    hidden_dims: Sequence[int],
    output_dim: int,
    *,
    activation: str = "elu",
    layer_norm: bool = False,
    hidden_gain: float = math.sqrt(2.0),
    output_gain: float = 1.0,
    device: torch.device | str | None = None,
) -> nn.Sequential:
    """Build Linear layers with activations between them; the last one is linear.

    Weights are orthogonal and biases zero: with such weights the scale of the signal does not depend on width or depth,
    and `output_gain` alone sets the scale of the first outputs (Andrychowicz et al., "What matters in on-policy
    reinforcement learning?", 2021: the gain of the last policy layer matters most, and should be small).

    Args:
        input_dim, output_dim: sizes of the first and the last dim L.
        hidden_dims: widths of the layers between; `()` gives one linear layer.
        activation: one of `ACTIVATIONS`.
        layer_norm: normalize before each activation.
        hidden_gain, output_gain: scales of the orthogonal weights.

    Returns:
        A module from [..., input_dim] to [..., output_dim].
    """
    check_in_range("output_gain", output_gain, low=0.0)
    layers = trunk(
        input_dim,
        hidden_dims,
        activation=activation,
        layer_norm=layer_norm,
        hidden_gain=hidden_gain,
        device=device,
    )
    width = hidden_dims[-1] if hidden_dims else input_dim
    return layers.append(linear(width, output_dim, gain=output_gain, device=device))


def trunk(
    input_dim: int,
    hidden_dims: Sequence[int],
    *,
    activation: str = "elu",
    layer_norm: bool = False,
    hidden_gain: float = math.sqrt(2.0),
    device: torch.device | str | None = None,
) -> nn.Sequential:
    """Build the hidden layers of an `mlp` alone, each with its activation.

    [..., input_dim] to the last width.
    """
    check_network(hidden_dims, activation)
    layers = nn.Sequential()
    width = input_dim
    for hidden_dim in hidden_dims:
        layers.append(linear(width, hidden_dim, gain=hidden_gain, device=device))
        if layer_norm:
            layers.append(nn.LayerNorm(hidden_dim, device=device))
        layers.append(ACTIVATIONS[activation]())
        width = hidden_dim
    return layers


def linear(
    input_dim: int, output_dim: int, *, gain: float, device: torch.device | str | None = None
) -> nn.Linear:
    """Build one layer with orthogonal weights of scale `gain` and zero bias."""
    # Drawn on the CPU, so that one seed gives the same network on every device.
    layer = nn.Linear(input_dim, output_dim)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer.to(device)
