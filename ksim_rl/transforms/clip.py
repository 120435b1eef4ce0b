"""Observations, rewards and actions are limited by the transforms of this module."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Num
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from ksim_rl import checks
from ksim_rl.transforms.elementwise import ActionMap, ObservationMap, RewardMap
from ksim_rl.transforms.row_transform import Keys, one_per_key
from ksim_rl.transforms.specs import bounded, bounds

Range = tuple[float | None, float | None]


class _Clip:
    """The limits of each key, and what they do to values and specs."""

    ranges: Sequence[Range]

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Narrow the bounds."""
        low, high = (end.clamp(*self.ranges[index]) for end in bounds(spec))
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        """Clip."""
        return torch.clamp(value, *self.ranges[index])


class ObservationClip(_Clip, ObservationMap):
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
        super().__init__(in_keys, out_keys)
        self.ranges = one_per_key("clip", clip, self.in_keys)
        for key, ends in zip(self.in_keys, self.ranges, strict=True):
            check_clip(f"clip of {key!r}", ends)


class RewardClip(_Clip, RewardMap):
    """Clip rewards to [low, high]; NaN stays NaN.

    Args:
        in_keys: rewards; nested keys as tuples.
        out_keys: where the clipped ones go. Default: in place.
        clip: (low, high); None is no limit on that side.

    Example:
        >>> clip = RewardClip(clip=(0.0, None))
    """

    def __init__(self, in_keys: Keys = "reward", out_keys: Keys | None = None, *, clip: Range) -> None:
        super().__init__(in_keys, out_keys)
        check_clip("clip", clip)
        self.ranges = [clip] * len(self.in_keys)


class ActionClip(_Clip, ActionMap):
    """The env receives the action clipped to [low, high]; the policy may ask for any number. NaN stays NaN.

    The tensordict keeps the action that the policy chose.

    Args:
        in_keys_inv: the actions that the env reads.
        out_keys_inv: where the policy writes them. Default: the same keys.
        clip: (low, high); None is no limit on that side.

    Example:
        >>> clip = ActionClip(clip=(-1.0, 1.0))
    """

    def __init__(
        self, in_keys_inv: Keys = "action", out_keys_inv: Keys | None = None, *, clip: Range
    ) -> None:
        super().__init__(in_keys_inv, out_keys_inv)
        check_clip("clip", clip)
        self.ranges = [clip] * len(self.in_keys_inv)

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Remove the bounds."""
        return Unbounded(spec.shape, dtype=spec.dtype, device=spec.device)


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
