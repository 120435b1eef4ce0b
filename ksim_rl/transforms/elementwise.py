"""Each value becomes a function of it alone, its clip or its scale, by the transforms of this module."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Num
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from ksim_rl import checks
from ksim_rl.transforms.checked_keys import CheckedKeys, Keys, one_per_key
from ksim_rl.transforms.noise.cfg import PerDim
from ksim_rl.transforms.row_transform import FollowsLevel, by_level
from ksim_rl.transforms.specs import bounded, bounds, multiply_bounds

Range = tuple[float | None, float | None]


def clipped(value: Num[Tensor, "*leaf"], clip: Range) -> Num[Tensor, "*leaf"]:
    """Return a value clamped to [low, high], either of which may be None; NaN stays NaN."""
    return torch.clamp(value, *clip)


class _Map(CheckedKeys):
    @abstractmethod
    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Return the new spec of the leaf of the in key with this index (for actions: the policy's spec)."""

    @abstractmethod
    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        """Return the new value for a value of that leaf."""


class _Outward(_Map):
    """Base for outputs of the env: floating-point leaves, replaced on batches of samples as in an env."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for index, (key, out_key) in enumerate(zip(self.in_keys, self.out_keys, strict=True)):
            next_tensordict.set(out_key, self.new_value(index, next_tensordict.get(key)))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do the same to a batch of samples."""
        self._check_samples(tensordict)
        return self._call(tensordict)


class ObservationMap(_Outward):
    """Base of those that replace observations, at resets too."""

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._replace_leaves(observation_spec, self.new_spec, is_floating=True)
        return observation_spec

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


class RewardMap(_Outward):
    """Base of those that replace rewards."""

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        self._replace_leaves(reward_spec, self.new_spec, is_floating=True)
        return reward_spec


class ActionMap(_Map):
    """Base of those that replace the action on its way to the env; the policy's own action stays, in samples too."""

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        self._replace_leaves(action_spec, self.new_spec, is_inverse=True, is_floating=True)
        return action_spec

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Samples of a replay hold the policy's actions, which must not be mapped a second time.
        if self._is_for_samples:
            return tensordict
        for index, (key, out_key) in enumerate(
            zip(self.in_keys_inv, self.out_keys_inv, strict=True)
        ):
            tensordict.set(key, self.new_value(index, tensordict.get(out_key)))
        return tensordict


class _Clip:
    """The limits of each key, (low, high) where one may be None, and their effect on values and specs."""

    ranges: Sequence[Range]

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        # Bounds are clipped as values are.
        low, high = (clipped(end, self.ranges[index]) for end in bounds(spec))
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        return clipped(value, self.ranges[index])


class ObservationClip(_Clip, ObservationMap):
    """Clip observations of floating point: `clip` is for all keys, or a mapping with one per key.

    Example:
        >>> clip = ObservationClip(["joint_vel"], clip=(-10.0, 10.0))
    """

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        clip: Range | Mapping[NestedKey, Range],
    ) -> None:
        super().__init__(in_keys, out_keys)
        # One range per key, so that units may differ from key to key.
        self.ranges = one_per_key("clip", clip, self.in_keys)
        for key, ends in zip(self.in_keys, self.ranges, strict=True):
            check_clip(f"clip of {key!r}", ends)


class RewardClip(_Clip, RewardMap):
    """Clip rewards.

    Example:
        >>> clip = RewardClip(clip=(0.0, None))
    """

    def __init__(
        self, in_keys: Keys = "reward", out_keys: Keys | None = None, *, clip: Range
    ) -> None:
        super().__init__(in_keys, out_keys)
        check_clip("clip", clip)
        self.ranges = [clip] * len(self.in_keys)


class ActionClip(_Clip, ActionMap):
    """The env receives the clipped action; the policy may ask for any number.

    Example:
        >>> clip = ActionClip(clip=(-1.0, 1.0))
    """

    def __init__(
        self, in_keys_inv: Keys = "action", out_keys_inv: Keys | None = None, *, clip: Range
    ) -> None:
        super().__init__(in_keys_inv=in_keys_inv, out_keys_inv=out_keys_inv)
        check_clip("clip", clip)
        self.ranges = [clip] * len(self.in_keys_inv)

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        # The clip makes any number an action, so that the policy sees no bounds.
        return Unbounded(spec.shape, dtype=spec.dtype, device=spec.device)


def check_clip(field: str, ends: Range) -> None:
    """Refuse all but a pair (low, high) with low < high and at least one limit."""
    if not isinstance(ends, tuple | list) or len(ends) != 2 or ends[0] is None and ends[1] is None:
        raise ValueError(f"{field}={ends!r}: expected a pair (low, high), where one may be None")
    for end in ends:
        if end is not None:
            checks.check_in_range(field, end)
    # Equal limits would make the observation a constant.
    if ends[0] is not None and ends[1] is not None and ends[0] >= ends[1]:
        raise ValueError(f"{field}={ends!r}: expected low < high")


class ObservationScale(ObservationMap):
    """Multiply observations by `scale`, a number or one per element of the last dim, or a mapping with one per key.

    Example:
        >>> scale = ObservationScale(["joint_vel"], scale=0.05)
    """

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        scale: PerDim | Mapping[NestedKey, PerDim],
    ) -> None:
        super().__init__(in_keys, out_keys)
        factors = one_per_key("scale", scale, self.in_keys)
        for index, (key, factor) in enumerate(zip(self.in_keys, factors, strict=True)):
            check_scale(f"scale of {key!r}", factor)
            # A buffer, as compiled code and other devices need the factor as a tensor.
            held = torch.tensor(factor, dtype=torch.float32)
            self.register_buffer(f"factor_{index}", held, persistent=False)

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        factor: Tensor = getattr(self, f"factor_{index}").to(spec.device)
        # A factor per element has to fit the last dim of the leaf.
        if factor.ndim:
            leaf = spec.shape[self.batch_dims[index] :]
            _check_per_dim(
                f"scale of {self.in_keys[index]!r}", factor.shape[0], "observation", leaf
            )
        factors = factor.expand(spec.shape), factor.expand(spec.shape)
        # A negative factor turns the bounds around.
        low, high = multiply_bounds(bounds(spec), factors)
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        # The float32 factors must not widen a leaf of lower precision.
        return (value * getattr(self, f"factor_{index}")).to(value.dtype)


class RewardScale(FollowsLevel, RewardMap):
    """Rewards as `scale * reward + offset`.

    With `first_scale`, that is the scale at level 0 of `follow_level_`, linear from there to `scale` at level 1.

    Example:
        >>> scale = RewardScale(scale=0.02)
    """

    def __init__(
        self,
        in_keys: Keys = "reward",
        out_keys: Keys | None = None,
        *,
        scale: float,
        offset: float = 0.0,
        first_scale: float | None = None,
    ) -> None:
        super().__init__(in_keys, out_keys)
        # `first_scale` is only there where a curriculum changes the scale.
        for name, value in (("scale", scale), ("offset", offset), ("first_scale", first_scale)):
            if value is not None:
                checks.check_in_range(name, value)
        self.scale = scale
        self.offset = offset
        self.first_scale = first_scale
        self._register_level(is_used=first_scale is not None)

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        low, high = bounds(spec)
        # The bounds hold at every level, so that both ends of the range of scales count.
        scales = self.scale, self.scale if self.first_scale is None else self.first_scale
        factors = torch.full_like(low, min(scales)), torch.full_like(low, max(scales))
        low, high = (end + self.offset for end in multiply_bounds((low, high), factors))
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        if self.first_scale is None:
            scale = self.scale
        else:
            scale = by_level(self.first_scale, self.scale, self.level)
        # Most rewards have none, and an addition would be one more kernel.
        if self.offset:
            return value * scale + self.offset
        return value * scale


class ActionScale(ActionMap):
    """The env receives `scale * action + offset`: numbers, or one per element of the last dim.

    A scale is not 0; None maps [-1, 1] to the bounds of the env.

    Example:
        >>> scale = ActionScale(scale=(0.25, 0.5), offset=0.1)
    """

    def __init__(
        self,
        in_keys_inv: Keys = "action",
        out_keys_inv: Keys | None = None,
        *,
        scale: PerDim | None = None,
        offset: PerDim = 0.0,
    ) -> None:
        super().__init__(in_keys_inv=in_keys_inv, out_keys_inv=out_keys_inv)
        if scale is None and offset != 0.0:
            raise ValueError(f"offset={offset!r} without scale: the bounds of the env give both")
        if scale is not None:
            check_scale("scale", scale)
            # The policy's bounds come from dividing by the scale.
            if 0 in (scale if isinstance(scale, Sequence) else [scale]):
                raise ValueError(f"scale={scale!r}: expected numbers other than 0")
        check_scale("offset", offset)
        self.scale = scale
        self.offset = offset
        for index in range(len(self.in_keys_inv)):
            # Made with the specs, from which the dtype and perhaps the bounds come.
            self.register_buffer(f"scale_{index}", None, persistent=False)
            self.register_buffer(f"offset_{index}", None, persistent=False)

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        scale, offset = self._affine(index, spec)
        # Set once: a captured step keeps its addresses.
        if self._buffers[f"scale_{index}"] is None:
            self._buffers[f"scale_{index}"] = scale
            self._buffers[f"offset_{index}"] = offset
        # The policy's bounds are the env's, mapped back; a negative scale turns them around.
        ends = [(end - offset) / scale for end in bounds(spec)]
        low = torch.minimum(*ends)
        high = torch.maximum(*ends)
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def _affine(self, index: int, spec: TensorSpec) -> tuple[Tensor, Tensor]:
        """Return scale and offset, one per element of the last dim, or per element of all dims from bounds."""
        key = self.in_keys_inv[index]
        leaf = spec.shape[self.batch_dims_inv[index] :]
        if self.scale is None:
            low, high = bounds(spec)
            if not bool((torch.isfinite(low) & torch.isfinite(high) & (low < high)).all()):
                raise ValueError(f"ActionScale: {key!r} has no finite bounds: give scale")
            # Half the range and the center map [-1, 1] to the bounds.
            return (high - low) / 2, (high + low) / 2
        for name, value in (("scale", self.scale), ("offset", self.offset)):
            if isinstance(value, Sequence):
                _check_per_dim(name, len(value), f"action {key!r}", leaf)
        scale, offset = (
            torch.tensor(value, dtype=spec.dtype, device=spec.device)
            for value in (self.scale, self.offset)
        )
        return scale, offset

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self._buffers["scale_0"] is None:
            # The action's bounds are in the specs only.
            assert self.container is not None and self.container.input_spec is not None
        return tensordict_reset

    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        scale = self._buffers[f"scale_{index}"]
        offset = self._buffers[f"offset_{index}"]
        if scale is None or offset is None:
            raise RuntimeError(
                "ActionScale knows its numbers once an env holds it and has made its specs"
            )
        return torch.addcmul(offset, value, scale)


def check_scale(field: str, scale: PerDim) -> None:
    """Refuse all but a finite number or a tuple of them."""
    for index, factor in enumerate(scale if isinstance(scale, tuple | list) else [scale]):
        checks.check_in_range(
            f"{field}[{index}]" if isinstance(scale, tuple | list) else field, factor
        )


def _check_per_dim(field: str, count: int, owner: str, leaf: torch.Size) -> None:
    if leaf[-1:] != (count,):
        raise ValueError(
            f"{field} has {count} numbers, but the {owner} has shape {tuple(leaf)} in each env: give 1 or one per "
            "element of the last dim"
        )
