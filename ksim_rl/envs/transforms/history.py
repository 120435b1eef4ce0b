"""The last frames of an observation."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from ksim_rl.envs.transforms.row_transform import Keys, RowTransform, as_keys, checked_out_keys
from ksim_rl.envs.transforms.specs import Device, bounded, bounds, leaf_spec, set_leaf_spec


class ObservationHistory(RowTransform):
    """The last N frames, oldest first; after a reset all N are the reset observation.

    Args:
        in_keys: observations, of any shape and dtype; nested keys as tuples.
        out_keys: where the histories go. Default: in place of the frames.
        length: N.
        flat: True gives one vector [E, N * L], frame after frame; False stacks to [E, N, ...].

    Example:
        >>> history = ObservationHistory(["joint_pos"], ["joint_pos_history"], length=10)
    """

    def __init__(
        self, in_keys: Keys, out_keys: Keys | None = None, *, length: int, flat: bool = True
    ) -> None:
        if isinstance(length, bool) or not isinstance(length, int) or length < 1:
            raise ValueError(f"length={length!r}: expected a whole number of frames of at least 1")
        in_keys = as_keys(in_keys)
        buffers = [f"frames_{index}" for index in range(len(in_keys))]
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys), row_buffers=buffers)
        self.length, self.flat = length, flat

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Repeat the specs N times."""
        batch_dims = observation_spec.ndim
        specs = [leaf_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        self._size_rows(observation_spec.shape.numel(), observation_spec.device)
        for index, (out_key, spec) in enumerate(zip(self.out_keys, specs, strict=True)):
            set_leaf_spec(observation_spec, out_key, self._repeated(spec, batch_dims))
            self._size_frames(index, spec.shape[batch_dims:], spec.dtype, observation_spec.device)
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

    def _size_frames(self, index: int, leaf: torch.Size, dtype: torch.dtype, device: Device) -> None:
        self._size_buffer(f"frames_{index}", (self.num_rows, self.length, *leaf), dtype, device)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        batch_dims = tensordict_reset.ndim
        values = [tensordict_reset.get(key) for key in self.in_keys]
        if self._buffers["frames_0"] is None or not self.num_rows:
            self._size_rows(tensordict_reset.batch_size.numel(), tensordict_reset.device)
            for index, value in enumerate(values):
                self._size_frames(index, value.shape[batch_dims:], value.dtype, tensordict_reset.device)
        mask_E = self._reset_rows(tensordict, tensordict_reset)
        for index, value in enumerate(values):
            frames_EN: Tensor = getattr(self, f"frames_{index}")
            frame_E1 = value.reshape(self.num_rows, 1, *value.shape[batch_dims:])
            mask = mask_E.reshape(-1, *[1] * (frames_EN.ndim - 1))
            self._write(tensordict_reset, index, torch.where(mask, frame_E1, frames_EN))
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        batch_dims = next_tensordict.ndim
        for index, key in enumerate(self.in_keys):
            frames_EN: Tensor = getattr(self, f"frames_{index}")
            value = next_tensordict.get(key)
            frame_E1 = value.reshape(self.num_rows, 1, *value.shape[batch_dims:])
            self._write(next_tensordict, index, torch.cat((frames_EN[:, 1:], frame_E1), dim=1))
        return next_tensordict

    def _write(self, tensordict: TensorDictBase, index: int, frames_EN: Tensor) -> None:
        """Keep the frames, and give them out in memory of their own: the kept ones change in place."""
        getattr(self, f"frames_{index}").copy_(frames_EN)
        out = frames_EN.flatten(1) if self.flat else frames_EN
        tensordict.set(self.out_keys[index], out.reshape(*tensordict.batch_size, *out.shape[1:]))
