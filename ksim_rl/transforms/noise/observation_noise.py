"""Sensor noise is added by the transform of this module."""

from collections.abc import Mapping, Sequence
from typing import Any, Self, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from ksim_rl.transforms.columns import side_by_side, split
from ksim_rl.transforms.keyed_transform import KeyedTransform
from ksim_rl.transforms.level import FollowsLevel
from ksim_rl.transforms.noise.cfg import NoiseCfg
from ksim_rl.transforms.noise.columns import NoiseColumns, widen
from ksim_rl.transforms.noise.kernel import (
    HAS_BIAS,
    HAS_DROPOUT,
    HAS_WALK,
    NoiseState,
    add_noise,
    reset_noise,
    step_noise,
)
from ksim_rl.transforms.row_transform import (
    Keys,
    RowTransform,
    as_keys,
    checked_out_keys,
)
from ksim_rl.transforms.specs import (
    Device,
    bounded,
    bounds,
    leaf_spec,
    set_leaf_spec,
)


class ObservationNoise(FollowsLevel, KeyedTransform):
    """Noise on floating-point observations, drawn once per env step, for the reset observation too.

    Given other `out_keys`, the clean reading stays beside the noisy one (for an asymmetric critic). All keys of one
    transform share one kernel, so one transform with many keys is cheaper than many with one.

    `env.eval()` turns it off and `env.train()` on again, `enable_` does the same for one transform; both write a device
    flag, so a captured or compiled step follows. Noise with `by_level` follows `follow_level_`.

    Args:
        in_keys: observations, of any shape; nested keys as tuples.
        out_keys: where the noisy ones go. Default: in place of the clean ones.
        noise: one for all keys, or a sequence or mapping with one per key.
        enabled: whether noise is on from the start.
        seed, stream: see `KeyedTransform`.

    Example:
        >>> noise = ObservationNoise(["imu"], noise=GaussianNoise(std=0.1, bias=UniformNoise(low=-0.2, high=0.2)))
    """

    purposes = ("step", "reset", "forward")

    enabled: Tensor
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
        seed: int = 0,
        stream: str | None = None,
    ) -> None:
        in_keys = as_keys(in_keys)
        out_keys = checked_out_keys(in_keys, out_keys)
        names = ("step_count_E", "bias_EL", "walk_EL", "last_EL")
        super().__init__(in_keys, out_keys, row_buffers=names, seed=seed, stream=stream)
        self.noise = _one_per_key(noise, self.in_keys)
        self._wanted = enabled
        self._layout: tuple[int, list[torch.Size]] | None = None
        self.noise_columns: NoiseColumns | None = None
        self.register_buffer("enabled", torch.tensor(enabled), persistent=False)
        self._register_level(is_used=any(cfg.by_level for cfg in self.noise))

    def enable_(self, enabled: bool = True) -> Self:
        """Turn the noise on or off, in place."""
        self._wanted = enabled
        self.enabled.fill_(enabled)
        return self

    def seed_(self, seed: int) -> Self:
        """Set the seed and start the counters anew, in place."""
        if self._buffers["step_count_E"] is not None:
            self.step_count_E.zero_()
        return super().seed_(seed)

    def train(self, mode: bool = True) -> Self:
        """Follow the mode of the env: noise is for training only."""
        super().train(mode)
        # TorchRL calls eval() on each transform that it attaches: that is no wish for evaluation.
        if self._in_env():
            self.enabled.fill_(self._wanted and mode)
        return self

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Widen the bounds by the reach of the noise."""
        batch_dims = observation_spec.ndim
        specs = [leaf_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        for key, spec in zip(self.in_keys, specs, strict=True):
            if not spec.dtype.is_floating_point:
                raise ValueError(
                    f"ObservationNoise: {key!r} is {spec.dtype}: noise needs floating-point observations"
                )
        for key, out_key, spec, cfg in zip(self.in_keys, self.out_keys, specs, self.noise, strict=True):
            low, high = widen(cfg, key, *bounds(spec), batch_dims)
            set_leaf_spec(observation_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        self._size_rows(observation_spec.shape.numel(), observation_spec.device)
        self._size_columns([spec.shape[batch_dims:] for spec in specs])
        return observation_spec

    def _size_rows(self, num_rows: int, device: Device) -> None:
        super()._size_rows(num_rows, device)
        self._size_buffer("step_count_E", (num_rows,), torch.int64, device)

    def _size_columns(self, shapes: list[torch.Size]) -> None:
        if self._layout == (self.num_rows, shapes):
            return
        self._layout = (self.num_rows, shapes)
        device = self.step_count.device
        columns = NoiseColumns(self.noise, self.in_keys, [shape.numel() for shape in shapes], device)
        self.noise_columns = columns
        shape = (self.num_rows, columns.size)
        if columns.has(HAS_BIAS):
            present = self._buffers["bias_EL"]
            if present is None or present.shape != shape:
                self._buffers["bias_EL"] = columns.neutral_bias().expand(shape).clone()
        if columns.has(HAS_WALK):
            self._size_buffer("walk_EL", shape, torch.float32, device)
        if columns.has(HAS_DROPOUT):
            self._size_buffer("last_EL", shape, torch.float32, device)

    def _size_by(self, tensordict: TensorDictBase) -> None:
        """Make what the specs have not made yet: TorchRL may reset or resume an env before it asks for them."""
        if self._layout is None:
            self._size_rows(tensordict.numel(), tensordict.device)
            self._size_columns([tensordict.get(key).shape[tensordict.ndim :] for key in self.in_keys])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._size_by(tensordict_reset)
        # The kernel counts the resets, and below the steps.
        mask_E = RowTransform._reset_rows(self, tensordict, tensordict_reset)
        values = [tensordict_reset.get(key) for key in self.in_keys]
        state, features = self._state()
        stream, counter_E = self._stream_ids["reset"], self.reset_count_E
        clean_EL = self._joined(values)
        noisy_EL = reset_noise(clean_EL, state, features, mask_E, stream=stream, counter_E=counter_E)
        return self._write(tensordict_reset, noisy_EL, values)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._size_by(next_tensordict)
        values = [next_tensordict.get(key) for key in self.in_keys]
        state, features = self._state()
        stream, counter_E = self._stream_ids["step"], cast(Tensor, self._buffers["step_count_E"])
        noisy_EL = step_noise(self._joined(values), state, features, stream=stream, counter_E=counter_E)
        return self._write(next_tensordict, noisy_EL, values)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add fresh noise to a batch of samples; they belong to no episode, so there is no bias, walk or dropout."""
        values = [tensordict.get(key) for key in self.in_keys]
        self._size_columns([value.shape[tensordict.ndim :] for value in values])
        state, features = self._state()
        stream, counter = self._stream_ids["forward"], self.step_count
        clean_EL = self._joined(values, tensordict.numel())
        noisy_EL = add_noise(clean_EL, state, features, stream=stream, counter=counter)
        self.step_count.add_(1)
        return self._write(tensordict, noisy_EL, values)

    def _state(self) -> tuple[NoiseState, int]:
        """Return what the kernel reads and changes, and what any column has."""
        # Look-ups by attribute go through `nn.Module` and would take a fifth of the step.
        buffers: dict[str, Any] = self._buffers
        columns: Any = self._modules["noise_columns"]
        parameters: dict[str, Any] = columns._buffers
        state = NoiseState(
            parameters["table_PL"],
            parameters["flags_L"],
            buffers["enabled"],
            buffers["level"],
            buffers["seed_value"],
            buffers["bias_EL"],
            buffers["walk_EL"],
            buffers["last_EL"],
        )
        return state, columns.features

    def _joined(self, values: list[Tensor], num_rows: int | None = None) -> Tensor:
        """Return the clean readings, float32: those of one observation as they are, several side by side [E, L]."""
        clean_EL = values[0]
        if len(values) > 1:
            clean_EL = side_by_side(values, self.num_rows if num_rows is None else num_rows)
        return clean_EL if clean_EL.dtype == torch.float32 else clean_EL.float()

    def _write(self, tensordict: TensorDictBase, noisy_EL: Tensor, values: list[Tensor]) -> TensorDictBase:
        found = [noisy_EL] if len(values) == 1 else split(noisy_EL, values)
        for out_key, noisy, value in zip(self.out_keys, found, values):  # noqa: B905 (takes time in every step)
            tensordict.set(out_key, noisy if noisy.dtype == value.dtype else noisy.to(value.dtype))
        return tensordict


def _one_per_key(
    noise: NoiseCfg | Sequence[NoiseCfg] | Mapping[NestedKey, NoiseCfg], in_keys: Sequence[NestedKey]
) -> list[NoiseCfg]:
    if isinstance(noise, NoiseCfg):
        return [noise] * len(in_keys)
    if isinstance(noise, Mapping):
        if set(noise) != set(in_keys):
            raise ValueError(
                f"noise has the keys {list(noise)}, but in_keys={list(in_keys)}: give one per key"
            )
        return [noise[key] for key in in_keys]
    if len(noise) != len(in_keys):
        raise ValueError(f"noise has {len(noise)} entries for the {len(in_keys)} of in_keys={list(in_keys)}")
    return list(noise)
