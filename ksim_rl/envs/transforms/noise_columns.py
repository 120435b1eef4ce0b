"""The noise of several observations side by side, so that one draw serves all of them."""

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from ksim_rl import random
from ksim_rl.envs.transforms.noise_cfg import ConstantNoise, GaussianNoise, NoiseCfg, PerDim, UniformNoise
from ksim_rl.envs.transforms.specs import add_bounds, multiply_bounds

_NEUTRAL = ConstantNoise(value=0.0)
_UNIFORM, _GAUSSIAN, _CONSTANT = range(3)


class NoiseColumns(nn.Module):
    """Parameters of the noise per column; a sample is `offset + spread * draw`.

    Args:
        cfgs: one per observation; None leaves its columns as they are.
        keys: their names, for errors.
        sizes: their numbers of columns.
    """

    offset_L: Tensor
    spread_L: Tensor
    multiply_L: Tensor
    order_L: Tensor

    def __init__(
        self,
        cfgs: Sequence[NoiseCfg | None],
        keys: Sequence[NestedKey],
        sizes: Sequence[int],
        device: torch.device | None,
    ) -> None:
        super().__init__()
        offset: list[float] = []
        spread: list[float] = []
        multiply: list[bool] = []
        kinds: list[int] = []
        for cfg, key, size in zip(cfgs, keys, sizes, strict=True):
            kind, offsets, spreads = _affine(cfg or _NEUTRAL, key, size)
            offset += offsets
            spread += spreads
            multiply += [(cfg or _NEUTRAL).operation == "multiply"] * size
            kinds += [kind] * size
        self.num_uniform, self.num_gaussian = kinds.count(_UNIFORM), kinds.count(_GAUSSIAN)
        self.size = len(kinds)
        self.all_add, self.all_multiply = not any(multiply), all(multiply)
        # Columns are drawn kind by kind; `order_L` says where in that row each column finds its draw.
        by_kind = sorted(range(self.size), key=lambda column: kinds[column])
        self.in_order = by_kind == list(range(self.size))
        place = {column: index for index, column in enumerate(by_kind)}
        tensors = {
            "offset_L": torch.tensor(offset, dtype=torch.float32),
            "spread_L": torch.tensor(spread, dtype=torch.float32),
            "multiply_L": torch.tensor(multiply),
            "order_L": torch.tensor([place[column] for column in range(self.size)]),
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor.to(device), persistent=False)

    def sample(self, keys_of: Callable[[str], random.RowKeys], num_rows: int) -> Tensor:
        """Return one sample per row and column, float32 [E, L]."""
        parts = []
        if self.num_uniform:
            parts.append(random.uniform(keys_of("uniform"), self.num_uniform))
        if self.num_gaussian:
            parts.append(random.normal(keys_of("gaussian"), self.num_gaussian))
        rest = self.size - self.num_uniform - self.num_gaussian
        if not parts:
            return self.offset_L.expand(num_rows, -1)
        if rest:
            parts.append(torch.zeros(num_rows, rest, device=self.offset_L.device))
        draw_EL = parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)
        if not self.in_order:
            draw_EL = draw_EL.index_select(1, self.order_L)
        return torch.addcmul(self.offset_L, self.spread_L, draw_EL)

    def apply_to(self, obs_EL: Tensor, sample_EL: Tensor) -> Tensor:
        """Add or multiply, column by column."""
        if self.all_add:
            return obs_EL + sample_EL
        if self.all_multiply:
            return obs_EL * sample_EL
        return torch.where(self.multiply_L, obs_EL * sample_EL, obs_EL + sample_EL)

    def neutral(self) -> Tensor:
        """Return the sample that changes nothing, [L]."""
        return self.multiply_L.to(torch.float32)


def widen(cfg: NoiseCfg | None, key: NestedKey, low: Tensor, high: Tensor, batch_dims: int) -> tuple[Tensor, Tensor]:
    """Return the bounds of the noisy observation; they hold the clean one too, as noise can be off."""
    if cfg is None:
        return low, high
    size = low.shape[batch_dims:].numel()
    kind, offset, spread = _affine(cfg, key, size)
    offset_L = torch.tensor(offset, device=low.device)
    spread_L = torch.tensor(spread, device=low.device)
    if kind == _GAUSSIAN:
        reach_L = torch.where(spread_L > 0, torch.inf, 0.0)
        noise_low, noise_high = offset_L - reach_L, offset_L + reach_L
    else:
        noise_low, noise_high = offset_L, offset_L + spread_L
    shape = low.shape[batch_dims:]
    noise = noise_low.reshape(shape).expand(low.shape), noise_high.reshape(shape).expand(low.shape)
    combine = multiply_bounds if cfg.operation == "multiply" else add_bounds
    noisy_low, noisy_high = combine(widen(cfg.bias, key, low, high, batch_dims), noise)
    return torch.minimum(low, noisy_low), torch.maximum(high, noisy_high)


def _affine(cfg: NoiseCfg, key: NestedKey, size: int) -> tuple[int, list[float], list[float]]:
    """Return the kind of draw, and per column the offset and the factor of the draw."""
    if isinstance(cfg, UniformNoise):
        low, high = _per_dim(cfg, "low", cfg.low, key, size), _per_dim(cfg, "high", cfg.high, key, size)
        return _UNIFORM, low, [b - a for a, b in zip(low, high, strict=True)]
    if isinstance(cfg, GaussianNoise):
        return _GAUSSIAN, _per_dim(cfg, "mean", cfg.mean, key, size), _per_dim(cfg, "std", cfg.std, key, size)
    if isinstance(cfg, ConstantNoise):
        return _CONSTANT, _per_dim(cfg, "value", cfg.value, key, size), [0.0] * size
    raise ValueError(
        f"noise of {key!r} is {cfg!r}: expected one of UniformNoise, GaussianNoise, ConstantNoise"
    )


def _per_dim(cfg: NoiseCfg, field: str, value: PerDim, key: NestedKey, size: int) -> list[float]:
    numbers = [float(number) for number in value] if isinstance(value, Sequence) else [float(value)]
    if len(numbers) not in (1, size):
        raise ValueError(
            f"{type(cfg).__name__}.{field} of {key!r} has {len(numbers)} numbers, "
            f"but the observation has {size} per env: give 1 or {size}"
        )
    return numbers * (size // len(numbers)) if size else []
