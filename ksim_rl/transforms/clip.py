"""Limits on observations."""

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from ksim_rl import checks
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import (
    bounded,
    bounds,
    floating_spec,
    set_leaf_spec,
)

Range = tuple[float | None, float | None]


class ObservationClip(Transform):
    """Clip observations to [low, high]; NaN stays NaN.

    Args:
        in_keys: floating-point observations; nested keys as tuples.
        out_keys: where the clipped ones go. Default: in place.
        clip: (low, high) for all keys, or a mapping with one per key; None is no limit on that side.

    Example:
        >>> clip = ObservationClip(["joint_vel"], clip=(-10.0, 10.0))
    """

    def __init__(
        self, in_keys: Keys, out_keys: Keys | None = None, *, clip: Range | Mapping[NestedKey, Range]
    ) -> None:
        in_keys = as_keys(in_keys)
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys))
        if isinstance(clip, Mapping) and set(clip) != set(self.in_keys):
            raise ValueError(f"clip has the keys {list(clip)}, but in_keys={self.in_keys}: give one per key")
        self.ranges = [clip[key] if isinstance(clip, Mapping) else clip for key in self.in_keys]
        for key, ends in zip(self.in_keys, self.ranges, strict=True):
            check_clip(f"clip of {key!r}", ends)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Narrow the bounds."""
        specs = [floating_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        for out_key, spec, (clip_low, clip_high) in zip(self.out_keys, specs, self.ranges, strict=True):
            low, high = (end.clamp(clip_low, clip_high) for end in bounds(spec))
            set_leaf_spec(observation_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        return observation_spec

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, out_key, (low, high) in zip(self.in_keys, self.out_keys, self.ranges, strict=True):
            next_tensordict.set(out_key, torch.clamp(next_tensordict.get(key), low, high))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do the same to a batch of samples."""
        return self._call(tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)


def check_clip(field: str, ends: Range) -> None:
    """Refuse what is no pair (low, high) with low < high and at least one limit.

    Raises:
        ValueError: naming the field and the value.
    """
    if not isinstance(ends, tuple | list) or len(ends) != 2 or ends[0] is None and ends[1] is None:
        raise ValueError(f"{field}={ends!r}: expected a pair (low, high), of which one may be None")
    for end in ends:
        if end is not None:
            checks.check_in_range(field, end)
    if ends[0] is not None and ends[1] is not None and ends[0] >= ends[1]:
        raise ValueError(f"{field}={ends!r}: expected low < high")
