"""Lays out the parameters of fused networks, cuts the work into parts, and names the networks that cannot be fused."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import torch
from jaxtyping import Float, Int32, Shaped
from tensordict import TensorDictBase
from torch import Tensor, nn

from ksim_rl.objectives.algorithm_cfg import PPOCfg
from ksim_rl.ranks.running_moments import RunningMoments

# The smallest dim that a tensor core multiplies.
MIN_WIDTH = 16
# In the order in which the kernels number them.
ACTIVATIONS = (nn.ELU, nn.ReLU, nn.Tanh, nn.SiLU)
# A program of the chained kernels holds in registers as a whole the observation and the second hidden layer. The limit
# holds a height scan beside the state: more would leave too few registers for the layers.
CHAINED_OBS = 320
CHAINED_SECOND = (16, 32, 64, 128, 256)
MAX_WIDTH = 1024
# In float32: as TF32 wider layers are no faster than torch's.
MAX_TF32_WIDTH = 256
MAX_ACTIONS = 64
# Kernels count places in 32 bits.
MAX_PLACES = 2**31
only_compiles = ContextVar("only_compiles", default=False)


# An argument of a Triton kernel: an array, a number of the launch, or a constant that it is compiled for.
Argument: TypeAlias = Shaped[Tensor, "*?shape"] | float | str | None


@dataclass(frozen=True, kw_only=True)
class Observer:
    """The inputs of a network's first layer: the result of `read`, [..., L], normalized by the `moments`, if any."""

    read: Callable[[TensorDictBase], Float[Tensor, "*batch L"]]
    moments: RunningMoments | None = None
    eps: float = 0.0

    @property
    def moments_given(self) -> dict[str, Argument]:
        """The arguments by which kernels normalize, by the names of their parameters."""
        if self.moments is None:
            mean = None
            var = None
        else:
            mean = self.moments.mean
            var = self.moments.var
        return {"mean": mean, "var": var, "eps": self.eps, "NORMALIZED": self.moments is not None}


@dataclass(frozen=True, kw_only=True)
class FusedNetworks:
    """The description of an actor and a critic for the kernels: two MLPs of as many layers, and a gaussian.

    The activation follows each linear layer but the last. The standard deviations, or their logarithms, are a parameter
    `std_A`, or the outputs of a `std_layer` on the last hidden layer: logarithms, or inputs of a softplus. The
    gradient passes the bound `min_std`. The `observers` read the inputs; `squashed`, if any, makes a `TanhGaussian`.
    """

    actor: Sequence[nn.Linear]
    critic: Sequence[nn.Linear]
    observers: tuple[Observer, Observer]
    std_A: Float[Tensor, " A"] | None = None
    std_layer: nn.Linear | None = None
    log_std: bool
    min_std: float
    activation: type[nn.Module] = nn.ELU
    squashed: Callable[..., Any] | None = None

    @property
    def parameters(self) -> list[Float[Tensor, "*?shape"]]:
        """All parameters, in the order of the flat form: of each layer weight and bias, of the actor then the std."""
        actor = [parameter for layer in self.actor for parameter in (layer.weight, layer.bias)]
        critic = [parameter for layer in self.critic for parameter in (layer.weight, layer.bias)]
        std: list[Any] = []
        if self.std_A is not None:
            std = [self.std_A]
        elif self.std_layer:
            std = [self.std_layer.weight, self.std_layer.bias]
        return [*actor, *std, *critic]

    @property
    def chained(self) -> bool:
        """Whether one program can take env states through all layers; else each layer is a kernel."""
        # Chained kernels are written for three hidden layers of the same widths in both networks.
        hidden = [layer.out_features for layer in self.actor[:-1]]
        return (
            self.std_layer is None
            and self.squashed is None
            and self.activation is not nn.SiLU
            and hidden == [layer.out_features for layer in self.critic[:-1]]
            and len(hidden) == 3
            and hidden[1] in CHAINED_SECOND
            and not any(width % MIN_WIDTH for width in hidden)
            and max(self.actor[0].in_features, self.critic[0].in_features) <= CHAINED_OBS
        )


@dataclass(frozen=True, kw_only=True)
class LayerPlace:
    """Where a layer is: its first weight and bias, and its first columns among layer inputs and among gradients."""

    fan_in: int
    fan_out: int
    weight: int
    bias: int
    input: int
    gradient: int


class FusedLayout:
    """Sizes and places of the parameters of `FusedNetworks`.

    There are two forms. The flat one, [N], has the parameters end to end as they are: the optimizer works on
    this form. The padded one, [2, P], has a row for the actor and one for the critic, each with first all weights and
    then all biases and the std, in blocks whose sizes are the same in both rows: the outputs are padded to `out`,
    a power of two, and so is the observation to `obs` where the kernels are `chained`, though it is `stored` as a
    multiple of 16; what else differs between both, or is no multiple of 16, is padded to one. The outputs of a
    `std_layer` follow the last layer's, its biases in the place of the std. Padding is zero, as is its gradient.
    """

    def __init__(self, networks: FusedNetworks, *, chained: bool | None = None) -> None:
        if chained is None:
            self.chained = networks.chained
        else:
            self.chained = chained
        pairs = zip(networks.actor[:-1], networks.critic[:-1], strict=True)
        # Layers of actor and critic that lie side by side take the room of the wider one.
        self.hidden = tuple(
            _multiple(max(of_actor.out_features, of_critic.out_features))
            for of_actor, of_critic in pairs
        )
        self.actions = networks.actor[-1].out_features
        self.obs_dims = networks.actor[0].in_features, networks.critic[0].in_features
        self.stored = _multiple(max(*self.obs_dims, MIN_WIDTH))
        if self.chained:
            self.obs = power_of_two(self.stored)
        else:
            self.obs = self.stored
        # The stored columns as two powers of two, where these are less than `obs`.
        head = 1 << (self.stored.bit_length() - 1)
        if self.stored > head:
            rest = power_of_two(self.stored - head)
        else:
            rest = 0
        if head + rest < self.obs:
            self.head = head
            self.rest = rest
        else:
            self.head = self.obs
            self.rest = 0
        # Outputs of both networks share one width, though the critic uses one column only.
        self.out = power_of_two(max(self.actions, MIN_WIDTH))
        if networks.std_layer is None:
            outputs = self.out
        else:
            outputs = 2 * self.out
        # Each layer's blocks begin where the blocks of the layer before it end.
        widths = (self.obs, *self.hidden, outputs)
        self.places: list[LayerPlace] = []
        weight = bias = column = gradient = 0
        for number, (fan_in, fan_out) in enumerate(itertools.pairwise(widths)):
            at = {"weight": weight, "bias": bias, "input": column, "gradient": gradient}
            self.places.append(LayerPlace(fan_in=fan_in, fan_out=fan_out, **at))
            weight = weight + fan_in * fan_out
            bias = bias + fan_out
            # The chained kernels never store the first hidden layer, nor its gradients.
            column += 0 if self.chained and number == 1 else fan_in
            gradient += 0 if self.chained and number == 0 else fan_out
        self.num_weights = weight
        self.num_biases = sum(self.hidden) + 2 * self.out
        self.num_padded = self.num_weights + self.num_biases
        self.num_flat = sum(parameter.numel() for parameter in networks.parameters)
        # Columns of a row of layer inputs (observation first), and of gradients of layer outputs. Where the kernels are
        # chained neither are of the first hidden layer.
        self.inputs = column
        self.gradients = gradient

    def padded_index(self, networks: FusedNetworks) -> Int32[Tensor, " N"]:
        """Return for each element of the flat form its place in the padded one, on the CPU."""
        # The places themselves are cut up like the padded form; the cuts are then the index.
        places = torch.arange(2 * self.num_padded, dtype=torch.int32).view(2, self.num_padded)
        index: list[Tensor] = []
        std_at = self.num_padded - self.out
        actions = self.actions
        for row, layers in zip(places, (networks.actor, networks.critic), strict=True):
            for layer, at in zip(layers, self.places, strict=True):
                block = row[at.weight :][: at.fan_in * at.fan_out].view(at.fan_out, at.fan_in)
                index.append(block[: layer.out_features, : layer.in_features])
                index.append(row[self.num_weights + at.bias :][: layer.out_features])
            # After the last layer, in the order of `FusedNetworks.parameters`.
            if layers is networks.actor:
                if networks.std_layer is not None:
                    index.append(block[self.out : self.out + actions, : layer.in_features])
                index.append(row[std_at : std_at + actions])
        return torch.cat([places.reshape(-1) for places in index])

    def weight_tiles(self, tile: int) -> Int32[Tensor, "tiles 8"]:
        """Return the work of each program of the weight gradient's kernel, on the CPU.

        Columns: network, first column among the layer inputs, first among the gradients, first place in the padded
        form, width of the layer's input, how many columns of inputs and of gradients the tile has, and the place of the
        first of its biases, or -1 where another tile has them. Where they are chained, `lower_gradients` has the first
        two layers but for the second one's biases, whose tiles have no columns of inputs.
        """
        tiles = []
        for network in range(2):
            for number, at in enumerate(self.places):
                for row in range(0, 0 if self.chained and number == 0 else at.fan_out, tile):
                    if self.chained and number == 1:
                        fan_in = 0
                    else:
                        fan_in = at.fan_in
                    for column in range(0, max(fan_in, 1), tile):
                        first = network, at.input + column, at.gradient + row
                        used = min(tile, fan_in - column), min(tile, at.fan_out - row)
                        # Only the first tile of a row of tiles adds up the biases' gradients.
                        if column:
                            bias = -1
                        else:
                            bias = self.num_weights + at.bias + row
                        tiles.append(
                            [*first, at.weight + row * at.fan_in + column, at.fan_in, *used, bias]
                        )
        return torch.tensor(tiles, dtype=torch.int32)


def _multiple(dim: int) -> int:
    return parts(dim, MIN_WIDTH) * MIN_WIDTH


def power_of_two(number: int) -> int:
    """Return the smallest power of two that is not below `number`."""
    return 1 << (number - 1).bit_length()


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """How work is cut. `of` gives the fastest sizes on an H200 for layers of 512, 256 and 128, but for `lower`."""

    block: int = 64  # rows of a minibatch that one program takes through a network or layer
    chunk: int = 32  # columns of the widest layer that exist at a time
    stages: int = 3  # how far loads of weights run ahead
    warps: int = 4
    tile: int = 128  # rows and columns of the weights whose gradient one program computes; outputs of a layer
    depth: int = 64  # rows of a minibatch, or inputs of a layer, that it multiplies at a time
    tile_stages: int = 3
    tile_warps: int = 8
    lower: int = 64  # elements of the first hidden layer that one program of `lower_gradients` has
    lower_depth: int = 32  # rows of a minibatch that it multiplies at a time
    lower_stages: int = 3
    lower_warps: int = 4
    splits: int = 8  # programs that share a tile, each with a part of the minibatch
    size: int = 1024  # elements per program in sums and Adam
    rows: int = 256  # of the blocks in which sums over programs are taken

    @classmethod
    def of(cls, layout: FusedLayout, dtype: torch.dtype) -> "Tuning":
        """Return sizes that suit a layout: chained, the first and the third width must be whole numbers of chunks."""
        # An element of float32 takes twice the registers and shared memory: so two programs share a multiprocessor.
        if dtype is torch.float32:
            wide: dict[str, int] = {"stages": 2, "tile": 64, "tile_warps": 4}
        else:
            wide = {}
        # Layers that run one at a time have no chunks.
        if not layout.chained:
            return cls(block=64 if wide else 128, **wide)
        chunk = math.gcd(cls.chunk, layout.hidden[0], layout.hidden[2])
        lower = math.gcd(32 if wide else cls.lower, layout.hidden[0])
        read = layout.head + layout.rest
        # Two programs of `lower_gradients` share a multiprocessor, where their sums fit into registers.
        stages = 3 if not wide and read <= 96 else 2
        warps = 4 if not wide and read <= 128 else 8
        if wide:
            wide |= {"block": 32, "lower_depth": 16}
        else:
            wide |= {"depth": 32, "tile_stages": 6}
            # Weights of long observations are read once for twice as many rows (259 of them, H200: 11.5 ms an update
            # of 20 steps of 24576 rows, 13.2 with blocks of 64).
            if read > 256:
                wide |= {"block": 128, "warps": 8}
        return cls(
            chunk=chunk, lower=lower, lower_stages=stages, lower_warps=warps, splits=16, **wide
        )


def why_not_fused(
    cfg: PPOCfg, networks: FusedNetworks, *, num_env_states_per_minibatch: int, num_minibatches: int
) -> str | None:
    """Return why the kernels cannot make the gradient steps of `cfg`, or None if they can."""
    if cfg.kernels == "torch":
        return "kernels='torch'"
    # Settings for which there are no kernels.
    refused = {
        "advantage": cfg.advantage != "gae",
        "value_lmbda": cfg.value_lmbda is not None,
        "estimate_each_epoch": cfg.estimates_each_epoch,
        "normalize_advantage": cfg.normalize_advantage == "minibatch",
    }
    for field, is_set in refused.items():
        if is_set:
            return f"{field}={getattr(cfg, field)!r}"
    if cfg.symmetry == "loss" and networks.squashed is not None:
        return "symmetry='loss', and the policy is squashed"
    of_actor = [layer.out_features for layer in networks.actor[:-1]]
    of_critic = [layer.out_features for layer in networks.critic[:-1]]
    if len(of_actor) != len(of_critic) or not of_actor:
        return f"actor and critic have hidden layers of {of_actor} and {of_critic}, not one or more, and as many"
    widest = max(*of_actor, *of_critic)
    if widest > MAX_WIDTH or networks.actor[-1].out_features > MAX_ACTIONS:
        return f"a hidden layer is wider than {MAX_WIDTH}, or there are more than {MAX_ACTIONS} actions"
    if cfg.precision == "float32":
        # The user asked for exact products, which tensor cores do not have.
        if torch.get_float32_matmul_precision() == "highest":
            return "precision='float32' with matmul_precision='highest', and the kernels multiply float32 as TF32"
        if widest > MAX_TF32_WIDTH:
            return f"precision='float32', and a hidden layer is wider than {MAX_TF32_WIDTH}: torch is as fast there"
    layout = FusedLayout(networks)
    rows = num_env_states_per_minibatch * (1 if cfg.symmetry == "none" else 2)
    columns = max(layout.inputs, layout.gradients, num_minibatches * layout.obs)
    too_many = f"{num_env_states_per_minibatch} env states in a minibatch are too many"
    if rows * columns >= MAX_PLACES:
        return too_many
    return None


def launch(
    kernel: Any,
    grid: tuple[int, ...],
    arguments: Mapping[str, Any],
    *,
    num_warps: int = 4,
    **changes: Argument,
) -> None:
    """Run `grid` programs of a Triton kernel, whose signature type checkers cannot read, on the current stream.

    It gets the `arguments` and `changes` that are its parameters; where `only_compiles` is set it only compiles.
    """
    given = {**arguments, **changes}
    if only_compiles.get():
        run = partial(kernel.warmup, grid=grid)
    else:
        run = kernel[grid]
    # Only the kernel's own parameters: callers pass everything they know.
    run(**{name: given[name] for name in kernel.arg_names}, num_warps=num_warps)


def parts(total: int, size: int) -> int:
    """Return how many programs of `size` elements cover `total`."""
    return -(-total // size)
