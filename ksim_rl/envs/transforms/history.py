"""The last frames of an observation."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from ksim_rl.envs.transforms import ring
from ksim_rl.envs.transforms.history_cfg import HistoryCfg
from ksim_rl.envs.transforms.row_transform import Keys, RowTransform, as_keys, checked_out_keys
from ksim_rl.envs.transforms.specs import Device, bounded, bounds, leaf_spec, set_leaf_spec


class ObservationHistory(RowTransform):
    """The last N frames, oldest first; frames from before a reset are the reset observation.

    Args:
        in_keys: observations, of any shape and dtype; nested keys as tuples.
        out_keys: where the histories go. Default: in place of the frames.
        length: N.
        stride: env steps from one frame to the next; 1 takes every one.
        flat: True gives one vector [E, N * L], frame after frame; False stacks to [E, N, ...].

    Example:
        >>> history = ObservationHistory(["joint_pos"], ["joint_pos_history"], length=10)
    """

    start_E: Tensor
    clock: Tensor
    lag_N: Tensor

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        length: int,
        stride: int = 1,
        flat: bool = True,
    ) -> None:
        HistoryCfg(length=length, stride=stride, flat=flat)
        in_keys = as_keys(in_keys)
        rings = [f"ring_{index}" for index in range(len(in_keys))]
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys), row_buffers=["start_E", *rings])
        self.length, self.stride, self.flat = length, stride, flat
        self.num_slots = (length - 1) * stride + 1
        self.register_buffer("clock", torch.zeros((), dtype=torch.int64))
        lag_N = torch.arange(length - 1, -1, -1) * stride
        self.register_buffer("lag_N", lag_N, persistent=False)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Repeat the specs N times."""
        batch_dims = observation_spec.ndim
        specs = [leaf_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        self._size_rows(observation_spec.shape.numel(), observation_spec.device)
        for index, (out_key, spec) in enumerate(zip(self.out_keys, specs, strict=True)):
            set_leaf_spec(observation_spec, out_key, self._repeated(spec, batch_dims))
            self._size_ring(index, spec.shape[batch_dims:], spec.dtype, observation_spec.device)
        return observation_spec

    def _repeated(self, spec: TensorSpec, batch_dims: int) -> TensorSpec:
        batch, leaf = spec.shape[:batch_dims], spec.shape[batch_dims:]
        stacked = spec.unsqueeze(batch_dims).expand(*batch, self.length, *leaf)
        if not self.flat:
            return stacked.clone()
        shape = torch.Size([*batch, self.length * leaf.numel()])
        if not isinstance(spec, Bounded) or not spec.dtype.is_floating_point:
            return Unbounded(shape, dtype=spec.dtype, device=spec.device)
        low, high = (end.reshape(shape) for end in bounds(stacked))
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def _size_rows(self, num_rows: int, device: Device) -> None:
        super()._size_rows(num_rows, device)
        self._size_buffer("start_E", (num_rows,), torch.int64, device)

    def _size_ring(self, index: int, leaf: torch.Size, dtype: torch.dtype, device: Device) -> None:
        self._size_buffer(f"ring_{index}", (self.num_rows, self.num_slots, *leaf), dtype, device)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        batch_dims = tensordict_reset.ndim
        values = [tensordict_reset.get(key) for key in self.in_keys]
        if self._buffers["ring_0"] is None or not self.num_rows:
            self._size_rows(tensordict_reset.batch_size.numel(), tensordict_reset.device)
            for index, value in enumerate(values):
                self._size_ring(index, value.shape[batch_dims:], value.dtype, tensordict_reset.device)
        mask_E = self._reset_rows(tensordict, tensordict_reset)
        for index, value in enumerate(values):
            value_E = value.reshape(self.num_rows, *value.shape[batch_dims:])
            ring_EM = getattr(self, f"ring_{index}")
            frames_EN = ring.begin(ring_EM, self.start_E, self.clock, value_E, mask_E, self.length)
            self._write(tensordict_reset, index, frames_EN)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        batch_dims = next_tensordict.ndim
        self.clock.add_(1)
        lag_EN = self.lag_N.expand(self.num_rows, -1)
        for index, key in enumerate(self.in_keys):
            value = next_tensordict.get(key)
            value_E = value.reshape(self.num_rows, *value.shape[batch_dims:])
            ring_EM = getattr(self, f"ring_{index}")
            frames_EN = ring.push_and_read(ring_EM, self.start_E, self.clock, value_E, lag_EN)
            self._write(next_tensordict, index, frames_EN)
        return next_tensordict

    def _write(self, tensordict: TensorDictBase, index: int, frames_EN: Tensor) -> None:
        out = frames_EN.flatten(1) if self.flat else frames_EN
        tensordict.set(self.out_keys[index], out.reshape(*tensordict.batch_size, *out.shape[1:]))
