"""This module lays the parameters of several observations' noise side by side, so that one draw serves all of them."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Float32
from tensordict import NestedKey
from torch import Tensor, nn

from ksim_rl.transforms.noise import kernel as noise_kernel
from ksim_rl.transforms.noise.cfg import Draw, NoiseCfg, per_dim
from ksim_rl.transforms.specs import Device, add_bounds, multiply_bounds


class NoiseColumns(nn.Module):
    """Parameters of the noise, column by column, as `noise_kernel` reads them.

    Attributes:
        features: which of bias, walk, resolution, dropout and normal draws any column has.

    Args:
        cfgs: one per observation.
        keys: their names, for errors.
        sizes: their numbers of columns.
    """

    table_PL: Tensor
    flags_L: Tensor

    def __init__(
        self, cfgs: Sequence[NoiseCfg], keys: Sequence[NestedKey], sizes: Sequence[int], device: Device
    ) -> None:
        super().__init__()
        self.size = sum(sizes)
        table = torch.zeros(noise_kernel.NUM_PARAMETERS, self.size)
        flags = torch.zeros(self.size, dtype=torch.int32)
        start = 0
        for index, (cfg, key, size) in enumerate(zip(cfgs, keys, sizes, strict=True)):
            columns = slice(start, start + size)
            table[:, columns] = torch.tensor(_parameters(cfg, key, size))
            flags[columns] = _flags(cfg) | index << noise_kernel.KEY_SHIFT
            start += size
        found = {
            noise_kernel.HAS_GAUSSIAN: any(_is_gaussian(cfg) or _is_gaussian(cfg.bias) for cfg in cfgs),
            noise_kernel.HAS_BIAS: any(cfg.bias is not None for cfg in cfgs),
            noise_kernel.HAS_WALK: bool(table[noise_kernel.WALK_STD].any()),
            noise_kernel.HAS_RESOLUTION: bool(table[noise_kernel.RESOLUTION].any()),
            noise_kernel.HAS_DROPOUT: bool(table[noise_kernel.DROPOUT].any()),
        }
        self.features = sum(feature for feature, is_there in found.items() if is_there)
        self.by_level = any(cfg.by_level for cfg in cfgs)
        self.register_buffer("table_PL", table.to(device), persistent=False)
        self.register_buffer("flags_L", flags.to(device), persistent=False)

    def has(self, feature: int) -> bool:
        """Whether any column has it."""
        return bool(self.features & feature)

    def neutral_bias(self) -> Float32[Tensor, " L"]:
        """Return the bias that changes nothing, [L]."""
        return (self.flags_L & noise_kernel.BIAS_MULTIPLY != 0).to(torch.float32)


def _parameters(cfg: NoiseCfg, key: NestedKey, size: int) -> list[list[float]]:
    """Return the parameters of one observation, one row per kind."""
    try:
        bias = cfg.bias.affine(size) if cfg.bias is not None else ([0.0] * size, [0.0] * size)
        rows = {
            noise_kernel.OFFSET: cfg.affine(size)[0],
            noise_kernel.SPREAD: cfg.affine(size)[1],
            noise_kernel.BIAS_OFFSET: bias[0],
            noise_kernel.BIAS_SPREAD: bias[1],
            noise_kernel.WALK_STD: per_dim("walk_std", cfg.walk_std, size),
            noise_kernel.RESOLUTION: per_dim("resolution", cfg.resolution, size),
            noise_kernel.DROPOUT: [cfg.dropout] * size,
        }
    except ValueError as error:
        raise ValueError(f"{type(cfg).__name__} of {key!r}: {error}") from None
    return [rows[row] for row in range(noise_kernel.NUM_PARAMETERS)]


def _flags(cfg: NoiseCfg) -> int:
    flags = {
        noise_kernel.GAUSSIAN: _is_gaussian(cfg),
        noise_kernel.MULTIPLY: cfg.operation == "multiply",
        noise_kernel.BIAS_GAUSSIAN: _is_gaussian(cfg.bias),
        noise_kernel.BIAS_MULTIPLY: cfg.bias is not None and cfg.bias.operation == "multiply",
        noise_kernel.BY_LEVEL: cfg.by_level,
        noise_kernel.HOLD: cfg.lost == "last",
    }
    return sum(flag for flag, is_set in flags.items() if is_set)


def _is_gaussian(cfg: NoiseCfg | None) -> bool:
    return cfg is not None and cfg.draw is Draw.GAUSSIAN


def widen(
    cfg: NoiseCfg, key: NestedKey, low: Float[Tensor, "*leaf"], high: Float[Tensor, "*leaf"], batch_dims: int
) -> tuple[Float[Tensor, "*leaf"], Float[Tensor, "*leaf"]]:
    """Return the bounds of the noisy observation; they hold the clean one too, as noise can be off or weaker."""
    shape = low.shape[batch_dims:]
    rows = [
        torch.tensor(row, device=low.device).reshape(shape) for row in _parameters(cfg, key, shape.numel())
    ]
    ends = low, high
    if cfg.bias is not None:
        ends = _noisy(cfg.bias, rows[noise_kernel.BIAS_OFFSET], rows[noise_kernel.BIAS_SPREAD], ends)
    drift = torch.where(rows[noise_kernel.WALK_STD] > 0, torch.inf, 0.0)
    ends = ends[0] - drift, ends[1] + drift
    ends = _noisy(cfg, rows[noise_kernel.OFFSET], rows[noise_kernel.SPREAD], ends)
    half = rows[noise_kernel.RESOLUTION] / 2
    lowest, highest = torch.minimum(low, ends[0] - half), torch.maximum(high, ends[1] + half)
    if cfg.dropout and cfg.lost == "zero":
        lowest, highest = lowest.clamp(max=0.0), highest.clamp(min=0.0)
    return lowest, highest


def _noisy(
    cfg: NoiseCfg, offset: Tensor, spread: Tensor, ends: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the bounds after a noise of any strength from none to full."""
    low, high = ends
    if cfg.draw is Draw.GAUSSIAN:
        reach = torch.where(spread > 0, torch.inf, 0.0)
        noise = (offset - reach).expand(low.shape), (offset + reach).expand(low.shape)
    else:
        noise = offset.expand(low.shape), (offset + spread).expand(low.shape)
    noisy_low, noisy_high = (multiply_bounds if cfg.operation == "multiply" else add_bounds)(ends, noise)
    return torch.minimum(low, noisy_low), torch.maximum(high, noisy_high)
