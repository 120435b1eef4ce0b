"""Observations show their last frames by the transform of this module."""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from ksim_rl import checks
from ksim_rl.transforms import ring
from ksim_rl.transforms.columns import side_by_side
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


@dataclass(frozen=True, kw_only=True)
class HistoryCfg:
    """The last `length` frames, oldest first.

    Args:
        length: number of frames.
        stride: env steps from one frame to the next.
        flat: True puts frame after frame into one vector; False stacks them along a dim of their own.
    """

    length: int
    stride: int = 1
    flat: bool = True

    def __post_init__(self) -> None:
        for field in ("length", "stride"):
            checks.check_count(field, getattr(self, field))
        if not isinstance(self.flat, bool):
            raise ValueError(f"flat={self.flat!r}: expected True or False")


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

    age_E: Tensor

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
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys), row_buffers=["age_E", *rings])
        self.length, self.stride, self.flat = length, stride, flat
        self.num_slots = (length - 1) * stride + 1
        self._is_joined = False
        # What all frames of an observation take in memory, where several are in one ring.
        self.register_buffer("part_bytes", None, persistent=False)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Repeat the specs N times."""
        batch_dims = observation_spec.ndim
        specs = [leaf_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        for out_key, spec in zip(self.out_keys, specs, strict=True):
            set_leaf_spec(observation_spec, out_key, self._repeated(spec, batch_dims))
        self._size_rings(
            observation_spec.shape.numel(),
            [spec.shape[batch_dims:] for spec in specs],
            [spec.dtype for spec in specs],
            observation_spec.device,
        )
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

    def _size_rings(
        self, num_rows: int, shapes: list[torch.Size], dtypes: list[torch.dtype], device: Device
    ) -> None:
        """Make one ring for all observations where they are of one dtype, and one for each otherwise."""
        self._size_rows(num_rows, device)
        self._size_buffer("age_E", (num_rows,), torch.int64, device)
        self._is_joined = len(shapes) > 1 and len(set(dtypes)) == 1
        if self._is_joined:
            sizes = [shape.numel() for shape in shapes]
            part_bytes = [size * dtypes[0].itemsize for size in sizes]
            self._buffers["part_bytes"] = torch.tensor(part_bytes, dtype=torch.int32).to(device)
            shapes, dtypes = [torch.Size([sum(sizes)])], dtypes[:1]
        for index, (shape, dtype) in enumerate(zip(shapes, dtypes, strict=True)):
            self._size_buffer(f"ring_{index}", (num_rows, self.num_slots, *shape), dtype, device)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        values = [tensordict_reset.get(key) for key in self.in_keys]
        if self._buffers["ring_0"] is None or not self.num_rows:
            shapes = [value.shape[tensordict_reset.ndim :] for value in values]
            dtypes = [value.dtype for value in values]
            self._size_rings(tensordict_reset.numel(), shapes, dtypes, tensordict_reset.device)
        return self._pass(tensordict_reset, values, self._reset_rows(tensordict, tensordict_reset))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._pass(next_tensordict, [next_tensordict.get(key) for key in self.in_keys], None)

    def _pass(
        self, tensordict: TensorDictBase, values: list[Tensor], mask_E: Tensor | None
    ) -> TensorDictBase:
        """Send the values through the rings, and write what comes out; a mask says which rows begin with them."""
        if self._is_joined:
            joined_EL = self._frames(0, side_by_side(values, self.num_rows), mask_E, counts=True)
            sizes = [self.length * value.numel() // self.num_rows for value in values]
            found = joined_EL.split(sizes, dim=1)
        else:
            last = len(values) - 1
            found = [
                self._frames(index, value, mask_E, counts=index == last) for index, value in enumerate(values)
            ]
        batch_size = tensordict.batch_size
        for out_key, value, frames_EL in zip(self.out_keys, values, found):  # noqa: B905 (takes time in every step)
            if not self.flat:
                frames_EL = frames_EL.reshape(*batch_size, self.length, *value.shape[len(batch_size) :])
            elif len(batch_size) != 1:
                frames_EL = frames_EL.reshape(*batch_size, -1)
            tensordict.set(out_key, frames_EL)
        return tensordict

    def _frames(self, index: int, value: Tensor, mask_E: Tensor | None, *, counts: bool) -> Tensor:
        """Return the frames of a ring, [E, N * L]."""
        buffers: dict[str, Any] = self._buffers
        ring_EM, age_E, parts = buffers[f"ring_{index}"], buffers["age_E"], buffers["part_bytes"]
        value_E = value if value.ndim == ring_EM.ndim - 1 else value.reshape(-1, *ring_EM.shape[2:])
        length = self.length
        if mask_E is not None:
            return ring.begin(ring_EM, age_E, value_E, mask_E, num_frames=length, parts_C=parts)
        return ring.push(
            ring_EM, age_E, value_E, num_frames=length, stride=self.stride, parts_C=parts, counts=counts
        )
