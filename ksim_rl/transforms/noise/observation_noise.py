"""Sensor noise is added by the transform of this module; all observations of one transform share a kernel."""

from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from jaxtyping import Float
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from ksim_rl.checks import naming
from ksim_rl.transforms.checked_keys import Keys, one_per_key
from ksim_rl.transforms.columns import side_by_side, split
from ksim_rl.transforms.noise import kernel as noise_kernel
from ksim_rl.transforms.noise.cfg import NoiseCfg, per_dim
from ksim_rl.transforms.noise.kernel import HAS_BIAS, HAS_DROPOUT, HAS_WALK, add_noise
from ksim_rl.transforms.row_transform import (
    FollowsLevel,
    KeyedTransform,
    RowTransform,
    Switched,
)
from ksim_rl.transforms.specs import Device, bounded, bounds, multiply_bounds


class ObservationNoise(FollowsLevel, Switched, KeyedTransform):
    """Noise on floating-point observations, drawn once per env step, for the reset observation too.

    Given other `out_keys`, the clean reading stays as well as the noisy one (for an asymmetric critic). All keys of one
    transform share one kernel, so one transform with many keys is cheaper than many with one.

    `env.eval()` turns it off and `env.train()` on again, `enable_` does the same for one transform; both write a device
    flag, so a captured or compiled step follows. Noise with `by_level` follows `follow_level_`.
    `noise` is one for all keys, or a sequence or mapping with one per key.

    Example:
        >>> noise = ObservationNoise(["imu"], noise=GaussianNoise(std=0.1, bias=UniformNoise(low=-0.2, high=0.2)))
    """

    purposes = ("step", "reset", "forward")

    step_count_E: Tensor
    bias_EL: Tensor | None
    walk_EL: Tensor | None
    last_EL: Tensor | None

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        noise: NoiseCfg | Sequence[NoiseCfg] | Mapping[NestedKey, NoiseCfg],
        enabled: bool = True,
        seed: int | None = None,
        stream: str | None = None,
    ) -> None:
        super().__init__(in_keys, out_keys, seed=seed, stream=stream)
        self._register_rows("step_count_E", "bias_EL", "walk_EL", "last_EL")
        self.noise = _one_per_key(noise, self.in_keys)
        self._layout: tuple[int, list[torch.Size]] | None = None
        self.noise_columns: NoiseColumns | None = None
        self._register_switch(enabled)
        self._register_level(is_used=any(cfg.by_level for cfg in self.noise))

    def seed_(self, seed: int) -> Self:
        """Set the seed and start the counters again, in place."""
        if self._buffers["step_count_E"] is not None:
            self.step_count_E.zero_()
        return super().seed_(seed)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        batch_dims = observation_spec.ndim

        def widened(index: int, spec: TensorSpec) -> TensorSpec:
            low, high = widen(self.noise[index], self.in_keys[index], *bounds(spec), batch_dims)
            return bounded(low, high, dtype=spec.dtype, device=spec.device)

        leaves = self._replace_leaves(observation_spec, widened, is_floating=True)
        self._size_rows(observation_spec)
        self._size_buffer("step_count_E", torch.int64)
        self._size_columns([leaf.shape[batch_dims:] for leaf in leaves], observation_spec.device)
        return observation_spec

    def _size_columns(self, shapes: list[torch.Size], device: Device) -> None:
        # Specs are made more than once: the state must survive that.
        if self._layout == (self.num_rows, shapes):
            return
        self._layout = (self.num_rows, shapes)
        columns = NoiseColumns(
            self.noise, self.in_keys, [shape.numel() for shape in shapes], device
        )
        self.noise_columns = columns
        shape = (self.num_rows, columns.size)
        if columns.has(HAS_BIAS):
            present = self._buffers["bias_EL"]
            if present is None or present.shape != shape:
                # A bias begins neutral: 1 for a factor, 0 for a summand.
                neutral_L = (columns.flags_L & noise_kernel.BIAS_MULTIPLY != 0).to(torch.float32)
                self._buffers["bias_EL"] = neutral_L.expand(shape).clone()
        for name, feature in (("walk_EL", HAS_WALK), ("last_EL", HAS_DROPOUT)):
            if columns.has(feature):
                self._size_buffer(name, torch.float32, (columns.size,))

    def _rows_that_reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> Tensor:
        # The kernel counts the resets, and in `_step` the steps.
        return RowTransform._rows_that_reset(self, tensordict, tensordict_reset)

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        return self._emit(tensordict_reset, "reset", self.reset_count_E, mask_E)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._emit(next_tensordict, "step", self._sized()["step_count_E"])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add fresh noise to a batch of samples; they belong to no episode, so there is no bias, walk or dropout."""
        self._check_samples(tensordict)
        self._take_seed()
        shapes = [tensordict.get(key).shape[tensordict.ndim :] for key in self.in_keys]
        self._size_columns(shapes, self.step_count.device)
        noisy = self._emit(tensordict, "forward", self.step_count)
        self.step_count.add_(1)
        return noisy

    def _emit(
        self, tensordict: TensorDictBase, moment: str, counter: Tensor, mask_E: Tensor | None = None
    ) -> TensorDictBase:
        values = [tensordict.get(key) for key in self.in_keys]
        # One observation needs no joining: the kernel takes it in its own shape.
        clean_EL = values[0]
        if len(values) > 1:
            clean_EL = side_by_side(
                values, tensordict.numel() if moment == "forward" else self.num_rows
            )
        # The kernel computes in float32; the results go back to the dtype of the leaf below.
        if clean_EL.dtype != torch.float32:
            clean_EL = clean_EL.float()
        # Look-ups by attribute go through `nn.Module` and would take a fifth of the step.
        buffers: dict[str, Any] = self._buffers
        columns: Any = self._modules["noise_columns"]
        parameters: dict[str, Any] = columns._buffers
        read = parameters["table_PL"], parameters["flags_L"], buffers["enabled"], buffers["level"]
        changed = buffers["bias_EL"], buffers["walk_EL"], buffers["last_EL"]
        state = *read, buffers["seed_value"], *changed
        drawn = mask_E, self._stream_ids[moment], counter
        noisy_EL = add_noise(clean_EL, *state, columns.features, moment, *drawn)
        if len(values) == 1:
            found = [noisy_EL]
        else:
            found = split(noisy_EL, values)
        for out_key, noisy, value in zip(self.out_keys, found, values):  # noqa: B905 (takes time in every step)
            tensordict.set(out_key, noisy if noisy.dtype == value.dtype else noisy.to(value.dtype))
        return tensordict


def _one_per_key(
    noise: NoiseCfg | Sequence[NoiseCfg] | Mapping[NestedKey, NoiseCfg],
    in_keys: Sequence[NestedKey],
) -> list[NoiseCfg]:
    if isinstance(noise, NoiseCfg | Mapping):
        return one_per_key("noise", noise, in_keys)
    if len(noise) != len(in_keys):
        raise ValueError(
            f"noise has {len(noise)} entries for the {len(in_keys)} of in_keys={list(in_keys)}"
        )
    return list(noise)


class NoiseColumns(nn.Module):
    """Parameters of the noise, column by column, as `noise_kernel` reads them; `features` is the union over columns.

    There are as many `cfgs`, `keys` (for errors) and `sizes` (numbers of columns) as observations.
    """

    table_PL: Tensor
    flags_L: Tensor

    def __init__(
        self,
        cfgs: Sequence[NoiseCfg],
        keys: Sequence[NestedKey],
        sizes: Sequence[int],
        device: Device,
    ) -> None:
        super().__init__()
        self.size = sum(sizes)
        # A row per parameter, a column per element of the observations side by side.
        table = torch.zeros(noise_kernel.NUM_PARAMETERS, self.size)
        flags = torch.zeros(self.size, dtype=torch.int32)
        start = 0
        for index, (cfg, key, size) in enumerate(zip(cfgs, keys, sizes, strict=True)):
            # Each observation fills its own columns of the table.
            columns = slice(start, start + size)
            table[:, columns] = torch.tensor(_parameters(cfg, key, size))
            flags[columns] = _flags(cfg) | index << noise_kernel.KEY_SHIFT
            start += size
        # A feature that no column has is skipped by the kernel for all of them.
        found = {
            noise_kernel.HAS_GAUSSIAN: any(
                _is_gaussian(cfg) or _is_gaussian(cfg.bias) for cfg in cfgs
            ),
            noise_kernel.HAS_BIAS: any(cfg.bias is not None for cfg in cfgs),
            noise_kernel.HAS_WALK: bool(table[noise_kernel.WALK_STD].any()),
            noise_kernel.HAS_RESOLUTION: bool(table[noise_kernel.RESOLUTION].any()),
            noise_kernel.HAS_DROPOUT: bool(table[noise_kernel.DROPOUT].any()),
        }
        self.features = sum(feature for feature, is_there in found.items() if is_there)
        self.register_buffer("table_PL", table.to(device), persistent=False)
        self.register_buffer("flags_L", flags.to(device), persistent=False)

    def has(self, feature: int) -> bool:
        """Whether any column has it."""
        return bool(self.features & feature)


def _parameters(cfg: NoiseCfg, key: NestedKey, size: int) -> list[list[float]]:
    """Return the parameters of one observation, in the order of the rows of `noise_kernel`'s table."""
    with naming(f"{type(cfg).__name__} of {key!r}"):
        if cfg.bias is not None:
            bias = cfg.bias.affine(size)
        else:
            bias = ([0.0] * size, [0.0] * size)
        walk, grain = (
            per_dim(name, getattr(cfg, name), size) for name in ("walk_std", "resolution")
        )
        return [*cfg.affine(size), *bias, walk, grain, [cfg.dropout] * size]


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
    return cfg is not None and cfg.is_gaussian


def widen(
    cfg: NoiseCfg,
    key: NestedKey,
    low: Float[Tensor, "*leaf"],
    high: Float[Tensor, "*leaf"],
    batch_dims: int,
) -> tuple[Float[Tensor, "*leaf"], Float[Tensor, "*leaf"]]:
    """Return the bounds of the noisy observation; they hold the clean one too, as noise can be off or weaker."""
    shape = low.shape[batch_dims:]
    rows = [
        torch.tensor(row, device=low.device).reshape(shape)
        for row in _parameters(cfg, key, shape.numel())
    ]
    # The stages of the reading, in the order of the kernel, each by its extremes.
    ends = low, high
    if cfg.bias is not None:
        ends = _noisy(
            cfg.bias, rows[noise_kernel.BIAS_OFFSET], rows[noise_kernel.BIAS_SPREAD], ends
        )
    # A random walk has no bounds.
    drift = torch.where(rows[noise_kernel.WALK_STD] > 0, torch.inf, 0.0)
    ends = ends[0] - drift, ends[1] + drift
    ends = _noisy(cfg, rows[noise_kernel.OFFSET], rows[noise_kernel.SPREAD], ends)
    # Rounding moves a reading by half a step at most.
    half = rows[noise_kernel.RESOLUTION] / 2
    lowest = torch.minimum(low, ends[0] - half)
    highest = torch.maximum(high, ends[1] + half)
    # A lost reading is zero, which may lie outside.
    if cfg.dropout and cfg.lost == "zero":
        lowest = lowest.clamp(max=0.0)
        highest = highest.clamp(min=0.0)
    return lowest, highest


def _noisy(
    cfg: NoiseCfg, offset: Tensor, spread: Tensor, ends: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the bounds after a noise of any strength from none to full."""
    low, high = ends
    if cfg.is_gaussian:
        # A gaussian reaches any number, unless its spread is zero.
        reach = torch.where(spread > 0, torch.inf, 0.0)
        noise = (offset - reach).expand(low.shape), (offset + reach).expand(low.shape)
    else:
        noise = offset.expand(low.shape), (offset + spread).expand(low.shape)
    # The clean bounds count as well: noise may be off, or of less than full strength.
    noisy_low = low + noise[0]
    noisy_high = high + noise[1]
    if cfg.operation == "multiply":
        noisy_low, noisy_high = multiply_bounds(ends, noise)
    return torch.minimum(low, noisy_low), torch.maximum(high, noisy_high)
