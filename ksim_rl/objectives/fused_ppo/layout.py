"""This module says where each parameter of a fused actor and critic is, in the two forms that the kernels need."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32
from torch import Tensor, nn

# The smallest dim that a tensor core multiplies.
MIN_WIDTH = 16


@dataclass(frozen=True, kw_only=True)
class FusedNetworks:
    """What the kernels need to know of an actor and a critic: two MLPs of the same hidden widths, and a gaussian.

    Attributes:
        actor, critic: their linear layers, the first to the last; an ELU follows each but the last.
        std_A: the parameter of the standard deviations.
        log_std: whether that is their logarithm.
        min_std: bound of the standard deviations from below, which the gradient passes.
    """

    actor: Sequence[nn.Linear]
    critic: Sequence[nn.Linear]
    std_A: Float[Tensor, " A"]
    log_std: bool
    min_std: float

    @property
    def parameters(self) -> list[Float[Tensor, "*?shape"]]:
        """All parameters, in the order of the flat form: of each layer weight and bias, of the actor then the std."""
        actor = [parameter for layer in self.actor for parameter in (layer.weight, layer.bias)]
        critic = [parameter for layer in self.critic for parameter in (layer.weight, layer.bias)]
        return [*actor, self.std_A, *critic]


class FusedLayout:
    """Sizes and places of the parameters of `FusedNetworks`.

    There are two forms. The flat one, [N], has the parameters end to end as they are, which is what the optimizer
    works on. The padded one, [2, P], has a row for the actor and one for the critic, each with first all weights and
    then all biases and the std, in blocks whose sizes are the same in both rows: the observation is padded to
    `obs_width` and the outputs to `out_width`, both powers of two. Padding is zero, and so is its gradient.

    Args:
        networks: what is laid out.
    """

    def __init__(self, networks: FusedNetworks) -> None:
        self.hidden = tuple(layer.out_features for layer in networks.actor[:-1])
        self.action_dim = networks.actor[-1].out_features
        self.obs_dims = networks.actor[0].in_features, networks.critic[0].in_features
        self.obs_width = _width(max(self.obs_dims))
        self.out_width = _width(self.action_dim)
        widths = (self.obs_width, *self.hidden, self.out_width)
        self.layers = list(zip(widths[:-1], widths[1:], strict=True))
        self.num_weights = sum(fan_in * fan_out for fan_in, fan_out in self.layers)
        self.num_biases = sum(self.hidden) + 2 * self.out_width
        self.num_padded = self.num_weights + self.num_biases
        self.num_flat = sum(parameter.numel() for parameter in networks.parameters)
        # Columns of a row of all layer inputs (observation first), and of all gradients of layer outputs.
        self.input_columns = sum(widths[:-1])
        self.gradient_columns = sum(widths[1:])

    def flat_views(
        self, flat_N: Float[Tensor, " N"], networks: FusedNetworks
    ) -> list[Float[Tensor, "*?shape"]]:
        """Return the views of a flat tensor that correspond to `networks.parameters`."""
        sizes = [parameter.numel() for parameter in networks.parameters]
        pieces = zip(flat_N.split(sizes), networks.parameters, strict=True)
        return [piece.view(parameter.shape) for piece, parameter in pieces]

    def padded_index(self, networks: FusedNetworks) -> Int32[Tensor, " N"]:
        """Return for each element of the flat form its place in the padded one, on the CPU."""
        places = torch.arange(2 * self.num_padded, dtype=torch.int32).view(2, self.num_padded)
        index: list[Tensor] = []
        for row, layers in zip(places, (networks.actor, networks.critic), strict=True):
            weight_at, bias_at = 0, self.num_weights
            for layer, (fan_in, fan_out) in zip(layers, self.layers, strict=True):
                block = row[weight_at : weight_at + fan_in * fan_out].view(fan_out, fan_in)
                index.append(block[: layer.out_features, : layer.in_features])
                index.append(row[bias_at : bias_at + layer.out_features])
                weight_at, bias_at = weight_at + fan_in * fan_out, bias_at + fan_out
            if layers is networks.actor:
                index.append(row[bias_at : bias_at + self.action_dim])
        return torch.cat([places.reshape(-1) for places in index])

    def weight_tiles(self, tile: int) -> Int32[Tensor, "tiles 8"]:
        """Return what each program of the weight gradient's kernel computes, on the CPU.

        Columns: network, first column among the layer inputs, first among the gradients, first place in the padded
        form, width of the layer's input, and how many columns of inputs and of gradients the tile has.
        """
        tiles = []
        for network in range(2):
            input_at = gradient_at = weight_at = 0
            for fan_in, fan_out in self.layers:
                for row in range(0, fan_out, tile):
                    for column in range(0, fan_in, tile):
                        place = weight_at + row * fan_in + column
                        used = min(tile, fan_in - column), min(tile, fan_out - row)
                        tiles.append([network, input_at + column, gradient_at + row, place, fan_in, *used, 0])
                input_at, gradient_at = input_at + fan_in, gradient_at + fan_out
                weight_at += fan_in * fan_out
        return torch.tensor(tiles, dtype=torch.int32)


def _width(dim: int) -> int:
    return max(MIN_WIDTH, power_of_two(dim))


def power_of_two(number: int) -> int:
    """Return the smallest power of two that is not below `number`."""
    return 1 << (number - 1).bit_length()
