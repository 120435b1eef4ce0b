"""The noise of several observations side by side, so that one draw serves all of them."""

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from ksim_rl import random
from ksim_rl.envs.transforms.noise_cfg import ConstantNoise, Draw, NoiseCfg
from ksim_rl.envs.transforms.specs import Device, add_bounds, multiply_bounds

_NEUTRAL = ConstantNoise(value=0.0)
_ORDER = (Draw.UNIFORM, Draw.GAUSSIAN, Draw.NONE)


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
        device: Device,
    ) -> None:
        super().__init__()
        offset: list[float] = []
        spread: list[float] = []
        multiply: list[bool] = []
        draws: list[Draw] = []
        for cfg, key, size in zip(cfgs, keys, sizes, strict=True):
            cfg = cfg or _NEUTRAL
            offsets, spreads = _affine(cfg, key, size)
            offset += offsets
            spread += spreads
            multiply += [cfg.operation == "multiply"] * size
            draws += [cfg.draw] * size
        self.num_uniform, self.num_gaussian = draws.count(Draw.UNIFORM), draws.count(Draw.GAUSSIAN)
        self.size = len(draws)
        self.all_add, self.all_multiply = not any(multiply), all(multiply)
        # Columns are drawn kind by kind; `order_L` says where in that row each column finds its draw.
        by_kind = sorted(range(self.size), key=lambda column: _ORDER.index(draws[column]))
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
        """Return one sample per row and column, float32 [E, L]; `keys_of` gives the keys of a kind of draw."""
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


def widen(
    cfg: NoiseCfg | None, key: NestedKey, low: Tensor, high: Tensor, batch_dims: int
) -> tuple[Tensor, Tensor]:
    """Return the bounds of the noisy observation; they hold the clean one too, as noise can be off."""
    if cfg is None:
        return low, high
    shape = low.shape[batch_dims:]
    offset, spread = _affine(cfg, key, shape.numel())
    offset_L = torch.tensor(offset, device=low.device)
    spread_L = torch.tensor(spread, device=low.device)
    if cfg.draw is Draw.GAUSSIAN:
        reach_L = torch.where(spread_L > 0, torch.inf, 0.0)
        ends = offset_L - reach_L, offset_L + reach_L
    else:
        ends = offset_L, offset_L + spread_L
    noise = ends[0].reshape(shape).expand(low.shape), ends[1].reshape(shape).expand(low.shape)
    combine = multiply_bounds if cfg.operation == "multiply" else add_bounds
    noisy_low, noisy_high = combine(widen(cfg.bias, key, low, high, batch_dims), noise)
    return torch.minimum(low, noisy_low), torch.maximum(high, noisy_high)


def _affine(cfg: NoiseCfg, key: NestedKey, size: int) -> tuple[list[float], list[float]]:
    try:
        return cfg.affine(size)
    except ValueError as error:
        raise ValueError(f"{type(cfg).__name__} of {key!r}: {error}") from None
