"""Builds the perceptrons of actors and critics, and runs their layers in half precision on CUDA."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn import functional

from ksim_rl.checked import Count, check_value
from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.device.gradient_context import GradientContext

Device = torch.device | str | None
# Of `_Product`.
SPLITS = 4
OUTPUTS = 2**16
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
    bound (Ball et al., "Efficient online reinforcement learning with offline data", 2023). N networks of this shape
    together map [N, B, input_dim] to [N, B, output_dim].
    """
    check_value("hidden_dims", hidden_dims, Sequence[Count])
    check_choice("activation", activation, ACTIVATIONS)
    check_in_range("output_gain", output_gain, low=0.0)
    layer: Callable[..., nn.Module] = linear
    norm: Callable[..., nn.Module] = nn.LayerNorm
    if num_networks is not None:
        layer = partial(EnsembleLinear, num_networks)
        norm = partial(EnsembleLayerNorm, num_networks)
    # `Layers` has kernels for ensembles and norms only; a plain perceptron stays torch's own module.
    if num_networks is None and not layer_norm:
        layers = nn.Sequential()
    else:
        layers = Layers()
    width = input_dim
    for hidden_dim in hidden_dims:
        # Gain sqrt(2) keeps the scale of the signal behind a ReLU, which halves its mean square.
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
        """Draw the weights again."""
        # Stored as [inputs, outputs] for the batched product, so that the drawn matrix is turned over.
        for network in self.weight:
            drawn = nn.init.orthogonal_(torch.empty(network.shape[::-1]), self.gain)
            network.copy_(drawn.t())
        self.bias.zero_()

    def forward(self, features_NBL: Float[Tensor, "#N B L"]) -> Float[Tensor, "N B M"]:
        """Return the outputs of each layer for its own input."""
        of_each_NBL = features_NBL.expand(len(self.weight), -1, -1)
        return torch.baddbmm(self.bias, of_each_NBL, self.weight)


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
        return torch.addcmul(
            self.bias, functional.layer_norm(features_NBL, (self.dim,)), self.weight
        )


class Layers(nn.Sequential):
    """Linear layers, norms and activations in a row, of one network, which takes [..., input_dim], or of an ensemble.

    With autocast on CUDA products are in bfloat16, and a norm, the bias before it and the activation after it are one
    kernel. An activation that the kernel does not have follows it.
    """

    def forward(self, features: Float[Tensor, "#*batch L"]) -> Float[Tensor, "*batch M"]:
        """Return the outputs of the last layer."""
        if not rounds(features):
            return super().forward(features)
        # Not above: Triton comes with torch for CUDA only.
        from ksim_rl.modules.norm_kernels import FUSED, Normalized

        # A single network runs as an ensemble of one, so that one path serves both.
        alone = not isinstance(self[0], EnsembleLinear)
        if alone:
            out = features.reshape(1, -1, features.shape[-1])
        else:
            out = features
        parts: list[nn.Module] = list(self)
        weights = [part.weight for part in parts if isinstance(part, nn.Linear | EnsembleLinear)]
        rounded = _rounded(weights)
        if alone:
            # As an ensemble of one network: inputs before outputs, networks in front.
            rounded = [own.mT[None] for own in rounded]
        while parts:
            layer = parts.pop(0)
            if not isinstance(layer, nn.Linear | EnsembleLinear):
                out = layer(out)
                continue
            # The exact weights get the gradients; their rounded copies are multiplied.
            out = _Product.apply(out, layer.weight, rounded.pop(0))
            if not parts or not isinstance(parts[0], nn.LayerNorm | EnsembleLayerNorm):
                out = out + layer.bias.to(out.dtype)
                continue
            # Bias, norm and activation are one kernel, which numbers its activations from 1; 0 leaves it out.
            norm = parts.pop(0)
            kind = type(parts[0]) if parts else None
            if kind in FUSED:
                known = FUSED.index(kind) + 1
            else:
                known = 0
            out = Normalized.apply(out, layer.bias, norm.weight, norm.bias, known)
            del parts[: bool(known)]
        if alone:
            return out.reshape(*features.shape[:-1], -1)
        return out


def rounds(features: Float[Tensor, "*batch L"]) -> bool:
    """Whether products of these are to be in bfloat16, on a device with kernels for the norm after them."""
    return features.is_cuda and torch.is_autocast_enabled("cuda")


class _MatmulContext(GradientContext, Protocol):
    alone: bool
    is_shared: bool
    sizes: torch.Size
    dtype: torch.dtype


class _Product(Function):
    """The products [N, B, M] of features [N, B, K] and weights [N, K, M], which are there `rounded` as well.

    Features [1, B, K] are shared by all networks. Weights of one network are [M, K], as torch has them. The gradient of
    the weights is a sum over env states in SPLITS parts, or as many as have OUTPUTS numbers: fewer would occupy a part
    of the GPU. It lies in memory as the weights do, since autograd copies any other layout.
    """

    @staticmethod
    def forward(
        ctx: _MatmulContext, features_NBK: Tensor, weight: Tensor, rounded: Tensor
    ) -> Tensor:
        ctx.alone = weight.dim() == 2
        fan_in, fan_out = ctx.sizes = weight.mT.shape if ctx.alone else weight.shape[1:]
        networks = len(rounded)
        ctx.is_shared = len(features_NBK) < networks
        # An input of all networks is cast once, unless weights learn by it: their gradient would copy it again.
        features = features_NBK.expand(networks if ctx.needs_input_grad[1] else -1, -1, -1)
        features = _padded(features, -fan_in % 8).expand(networks, -1, -1)
        ctx.save_for_backward(features, rounded)
        ctx.dtype = features_NBK.dtype
        return torch.bmm(features, rounded)[..., :fan_out]

    @staticmethod
    def backward(ctx: _MatmulContext, d_out: Tensor) -> tuple[Tensor | None, ...]:
        features, rounded = ctx.saved_tensors
        fan_in, fan_out = ctx.sizes
        d_out = _padded(d_out, -fan_out % 8)
        d_features = d_weight = None
        if ctx.needs_input_grad[0]:
            # The rounded weights of the forward pass again, padded columns cut off.
            d_features = torch.bmm(d_out, rounded.mT)[..., :fan_in].to(ctx.dtype)
            if ctx.is_shared:
                d_features = d_features.sum(0, keepdim=True)
        if ctx.needs_input_grad[1]:
            networks, rows = features.shape[:2]
            # The split has to divide the rows, since each part is one product of a batch.
            splits = math.gcd(SPLITS * max(OUTPUTS // rounded.numel(), 1), rows)
            parts = [
                part.reshape(networks * splits, rows // splits, -1) for part in (features, d_out)
            ]
            if ctx.alone:
                parts = parts[::-1]
                fan_in, fan_out = fan_out, fan_in
            sums = torch.bmm(parts[0].mT, parts[1]).unflatten(0, (networks, splits))
            # Parts are added up in float32: their sum would lose digits in bfloat16.
            d_weight = sums[..., :fan_in, :fan_out].sum(1, dtype=torch.float32)
            if ctx.alone:
                d_weight = d_weight[0]
        return d_features, d_weight, None


@torch.no_grad()
def _rounded(weights: list[Tensor]) -> list[Tensor]:
    """Return weights in bfloat16, padded to whole 16 bytes in each dim, all by one kernel of compiled code.

    Tensor cores are fast with such rows: 315 inputs take three times as long as 320.
    """
    padded = []
    for own in weights:
        columns = -own.shape[-1] % 8
        rows = -own.shape[-2] % 8
        padded.append(functional.pad(own, (0, columns, 0, rows)))
    flat = torch.cat([own.reshape(-1) for own in padded]).to(torch.bfloat16)
    parts = flat.split([own.numel() for own in padded])
    return [part.view_as(own) for part, own in zip(parts, padded, strict=True)]


def _padded(features: Tensor, columns: int) -> Tensor:
    features = features.to(torch.bfloat16)
    if columns:
        return functional.pad(features, (0, columns))
    return features
