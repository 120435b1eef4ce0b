"""This module has layers of several networks at once, and how layers run in half precision on CUDA."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn import functional

Device = torch.device | str | None
EPS = 1e-5  # of layer norms
SPLITS = 8  # see `_Product`


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
        return torch.baddbmm(self.bias, features_NBL, self.weight)


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
        return self.bias + functional.layer_norm(features_NBL, (self.dim,), eps=EPS) * self.weight


class Layers(nn.Sequential):
    """Linear layers, norms and activations in a row, which take [..., input_dim], or those of ensembles in a row.

    With autocast on CUDA products are in bfloat16, and a norm, the bias before it and the activation after it are one
    kernel. An activation that the kernel does not have follows it.
    """

    def forward(self, features: Float[Tensor, "*batch L"]) -> Float[Tensor, "*batch M"]:
        """Return what the last layer gives."""
        if not rounds(features):
            return super().forward(features)
        # Not above: Triton comes with torch for CUDA only.
        from ksim_rl.modules.norm_kernels import ACTIVATIONS, normalized

        alone = not isinstance(self[0], EnsembleLinear)
        out = features.reshape(1, -1, features.shape[-1]) if alone else features
        parts: list[Any] = list(self)
        rounded = _rounded([part.weight for part in parts if isinstance(part, nn.Linear | EnsembleLinear)])
        while parts:
            layer = parts.pop(0)
            if not isinstance(layer, nn.Linear | EnsembleLinear):
                out = layer(out)
                continue
            weight, of_product = layer.weight, rounded.pop(0)
            if alone:
                weight, of_product = weight.mT[None], of_product.mT[None]
            out = _Product.apply(out, weight, of_product)
            if not parts or not isinstance(parts[0], nn.LayerNorm | EnsembleLayerNorm):
                out = out + layer.bias.to(out.dtype)
                continue
            norm = parts.pop(0)
            kind = type(parts[0]) if parts else None
            known = ACTIVATIONS.index(kind) + 1 if kind in ACTIVATIONS else 0
            out = normalized(out, layer.bias, norm.weight, norm.bias, EPS, known)
            del parts[: bool(known)]
        return out.reshape(*features.shape[:-1], -1) if alone else out


def rounds(features: Float[Tensor, "*batch L"]) -> bool:
    """Whether products of these are to be in bfloat16, on a device with kernels for what follows."""
    return features.is_cuda and torch.is_autocast_enabled("cuda")


class _Product(Function):
    """The products [N, B, M] of features [N, B, K] and weights [N, K, M], which are there `rounded` as well.

    The gradient of the weights is a sum over env states in SPLITS parts: its outputs alone, which are few, would occupy
    a part of the GPU.
    """

    @staticmethod
    def forward(ctx: Any, features_NBK: Tensor, weight_NKM: Tensor, rounded: Tensor) -> Tensor:
        fan_in, fan_out = ctx.sizes = weight_NKM.shape[1:]
        features = _padded(features_NBK, -fan_in % 8)
        ctx.save_for_backward(features, rounded)
        ctx.dtype = features_NBK.dtype
        return torch.bmm(features, rounded)[..., :fan_out]

    @staticmethod
    def backward(ctx: Any, d_out: Tensor) -> tuple[Tensor | None, ...]:
        features, rounded = ctx.saved_tensors
        fan_in, fan_out = ctx.sizes
        d_out = _padded(d_out, -fan_out % 8)
        d_features = d_weight = None
        if ctx.needs_input_grad[0]:
            d_features = torch.bmm(d_out, rounded.mT)[..., :fan_in].to(ctx.dtype)
        if ctx.needs_input_grad[1]:
            networks, rows = features.shape[:2]
            splits = math.gcd(SPLITS, rows)
            parts = [part.reshape(networks * splits, rows // splits, -1) for part in (features, d_out)]
            sums = torch.bmm(parts[0].mT, parts[1]).unflatten(0, (networks, splits))
            d_weight = sums.sum(1, dtype=torch.float32)[:, :fan_in, :fan_out]
        return d_features, d_weight, None


@torch.no_grad()
def _rounded(weights: list[Tensor]) -> list[Tensor]:
    """Return weights in bfloat16, padded to whole 16 bytes in each dim, all by one kernel of compiled code.

    Tensor cores are fast with such rows: 315 inputs take three times as long as 320.
    """
    padded = [functional.pad(own, (0, -own.shape[-1] % 8, 0, -own.shape[-2] % 8)) for own in weights]
    flat = torch.cat([own.reshape(-1) for own in padded]).to(torch.bfloat16)
    parts = zip(flat.split([own.numel() for own in padded]), padded, strict=True)
    return [part.view_as(own) for part, own in parts]


def _padded(features: Tensor, columns: int) -> Tensor:
    features = features.to(torch.bfloat16)
    return functional.pad(features, (0, columns)) if columns else features
