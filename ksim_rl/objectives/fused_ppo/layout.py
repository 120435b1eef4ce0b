"""This module says where the parameters of fused networks are, how work is cut, and what cannot be fused."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int32
from torch import Tensor, nn

from ksim_rl.objectives.algorithm_cfg import PPOCfg

# The smallest dim that a tensor core multiplies.
MIN_WIDTH = 16
# In the order in which the kernels number them.
ACTIVATIONS = (nn.ELU, nn.ReLU, nn.Tanh)


@dataclass(frozen=True, kw_only=True)
class FusedNetworks:
    """What the kernels need to know of an actor and a critic: two MLPs of the same hidden widths, and a gaussian.

    The activation follows each linear layer but the last. The gradient passes the bound `min_std`.
    """

    actor: Sequence[nn.Linear]
    critic: Sequence[nn.Linear]
    std_A: Float[Tensor, " A"]  # the parameter of the standard deviations, or their logarithms
    log_std: bool
    min_std: float
    activation: type[nn.Module] = nn.ELU

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


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """How the work is cut. The defaults were the fastest on an H200 for layers of 512, 256 and 128."""

    block: int = 64  # rows of a minibatch that one program takes through a network
    chunk: int = 32  # columns of the widest layer that exist at a time
    stages: int = 3  # how far loads of weights run ahead
    warps: int = 4
    tile: int = 128  # rows and columns of the weights whose gradient one program computes
    depth: int = 64  # rows of a minibatch that it multiplies at a time
    tile_stages: int = 3
    tile_warps: int = 8
    splits: int = 8  # programs that share a tile, each with a part of the minibatch
    size: int = 1024  # elements per program in sums and Adam
    columns: int = 32  # of the blocks in which sums over programs are taken, as are the rows
    rows: int = 64

    @classmethod
    def of(cls, layout: FusedLayout) -> "Tuning":
        """Return what suits a layout: the first and the third width must be whole numbers of chunks."""
        return cls(chunk=math.gcd(cls.chunk, layout.hidden[0], layout.hidden[2]))


MAX_OBS = 256
MAX_ACTIONS = 64
# The second hidden layer is held in registers as a whole; the others are computed in chunks.
SECOND_WIDTHS = (16, 32, 64, 128, 256)
WIDTH_STEP = 16
MAX_PLACES = 2**31


def why_not_fused(
    cfg: PPOCfg, networks: FusedNetworks, *, num_env_states_per_minibatch: int, num_minibatches: int
) -> str | None:
    """Return why the kernels cannot make the gradient steps of `cfg`, or None if they can."""
    if cfg.kernels == "torch":
        return "kernels='torch'"
    if cfg.precision == "float32":
        # As TF32 they would be no faster than torch's.
        return "precision='float32', and the kernels multiply bfloat16"
    refused = {
        "advantage": cfg.advantage != "gae",
        "estimate_each_epoch": cfg.estimates_each_epoch,
        "symmetry": cfg.symmetry != "none",
        "normalize_advantage": cfg.normalize_advantage == "minibatch",
    }
    for field, is_set in refused.items():
        if is_set:
            return f"{field}={getattr(cfg, field)!r}"
    columns = sum(layer.out_features for layer in networks.actor) + MAX_OBS
    places = num_env_states_per_minibatch * max(columns, num_minibatches * MAX_OBS)
    too_many = f"{num_env_states_per_minibatch} env states in a minibatch are too many"
    return _shape_reason(networks) or (too_many if places >= MAX_PLACES else None)


def _shape_reason(networks: FusedNetworks) -> str | None:
    hidden = [layer.out_features for layer in networks.actor[:-1]]
    if hidden != [layer.out_features for layer in networks.critic[:-1]] or len(hidden) != 3:
        return "actor and critic do not both have the same three hidden layers"
    if hidden[1] not in SECOND_WIDTHS or any(width % WIDTH_STEP for width in hidden):
        return (
            f"hidden_dims={tuple(hidden)}: the second must be one of {SECOND_WIDTHS}, the others multiples "
            f"of {WIDTH_STEP}"
        )
    widest = max(networks.actor[0].in_features, networks.critic[0].in_features)
    if widest > MAX_OBS or networks.actor[-1].out_features > MAX_ACTIONS:
        return f"there are more than {MAX_OBS} observations or {MAX_ACTIONS} actions"
    return None


def launch(kernel: Any, grid: tuple[int, ...], *args: Any, **options: Any) -> None:
    """Run `grid` programs of a Triton kernel, whose signature type checkers cannot read, on the current stream."""
    kernel[grid](*args, **options)


def parts(total: int, size: int) -> int:
    """Return how many programs of `size` elements cover `total`."""
    return -(-total // size)
