"""Observations, rewards and actions get other units from the transforms of this module."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Num
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec

from ksim_rl import checks
from ksim_rl.transforms.elementwise import ActionMap, ObservationMap, RewardMap
from ksim_rl.transforms.noise.cfg import PerDim
from ksim_rl.transforms.row_transform import FollowsLevel, Keys, one_per_key
from ksim_rl.transforms.specs import add_bounds, bounded, bounds, multiply_bounds


class ObservationScale(ObservationMap):
    """Multiply observations by a fixed factor.

    Args:
        in_keys: floating-point observations; nested keys as tuples.
        out_keys: where the scaled ones go. Default: in place.
        scale: a number or one per element of the last dim, for all keys; or a mapping with one of these per key.

    Example:
        >>> scale = ObservationScale(["joint_vel"], scale=0.05)
    """

    def __init__(
        self, in_keys: Keys, out_keys: Keys | None = None, *, scale: PerDim | Mapping[NestedKey, PerDim]
    ) -> None:
        super().__init__(in_keys, out_keys)
        for index, (key, factor) in enumerate(
            zip(self.in_keys, one_per_key("scale", scale, self.in_keys), strict=True)
        ):
            check_scale(f"scale of {key!r}", factor)
            held = torch.tensor(factor, dtype=torch.float32)
            self.register_buffer(f"factor_{index}", held, persistent=False)

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Scale the bounds."""
        factor: Tensor = getattr(self, f"factor_{index}").to(spec.device)
        if factor.ndim:
            _check_per_dim(f"scale of {self.in_keys[index]!r}", factor.shape[0], "observation", spec)
        factors = factor.expand(spec.shape), factor.expand(spec.shape)
        low, high = multiply_bounds(bounds(spec), factors)
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        """Scale."""
        return (value * getattr(self, f"factor_{index}")).to(value.dtype)


class RewardScale(FollowsLevel, RewardMap):
    """Rewards as `scale * reward + offset`.

    Args:
        in_keys: rewards; nested keys as tuples.
        out_keys: where the scaled ones go. Default: in place.
        scale, offset: finite numbers.
        first_scale: the scale at level 0 of `follow_level_`, linear from there to `scale` at level 1; None leaves it
            at `scale`.

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
        checks.check_in_range("scale", scale)
        checks.check_in_range("offset", offset)
        if first_scale is not None:
            checks.check_in_range("first_scale", first_scale)
        self.scale, self.offset, self.first_scale = scale, offset, first_scale
        self._register_level(is_used=first_scale is not None)

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Scale and shift the bounds."""
        low, high = bounds(spec)
        scales = self.scale, self.scale if self.first_scale is None else self.first_scale
        factors = torch.full_like(low, min(scales)), torch.full_like(low, max(scales))
        shift = torch.full_like(low, self.offset)
        low, high = add_bounds(multiply_bounds((low, high), factors), (shift, shift))
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        """Scale and shift."""
        scale = self.scale
        if self.first_scale is not None:
            scale = self.first_scale + (self.scale - self.first_scale) * self.level
        scaled = value * scale
        return scaled + self.offset if self.offset else scaled


class ActionScale(ActionMap):
    """The env receives `scale * action + offset`; the tensordict keeps the action that the policy chose.

    Args:
        in_keys_inv: the actions that the env reads.
        out_keys_inv: where the policy writes them. Default: the same keys.
        scale: a number other than 0, or one per element of the last dim. None maps [-1, 1] to the bounds of the env.
        offset: as scale; left out where `scale` is None.

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
        super().__init__(in_keys_inv, out_keys_inv)
        if scale is None and offset != 0.0:
            raise ValueError(f"offset={offset!r} without scale: the bounds of the env give both")
        if scale is not None:
            check_scale("scale", scale)
            if 0 in (scale if isinstance(scale, Sequence) else [scale]):
                raise ValueError(f"scale={scale!r}: expected numbers other than 0")
        check_scale("offset", offset)
        self.scale, self.offset = scale, offset
        for index in range(len(self.in_keys_inv)):
            self.register_buffer(f"scale_{index}", None, persistent=False)
            self.register_buffer(f"offset_{index}", None, persistent=False)

    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Undo the scale in the bounds."""
        scale, offset = self._affine(str(self.in_keys_inv[index]), spec)
        if self._buffers[f"scale_{index}"] is None:
            self._buffers[f"scale_{index}"], self._buffers[f"offset_{index}"] = scale, offset
        ends = [(end - offset) / scale for end in bounds(spec)]
        low, high = torch.minimum(*ends), torch.maximum(*ends)
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def _affine(self, key: str, spec: TensorSpec) -> tuple[Tensor, Tensor]:
        """Return scale and offset, one per element of the last dim, or per element of all dims from bounds."""
        if self.scale is None:
            low, high = bounds(spec)
            if not bool((torch.isfinite(low) & torch.isfinite(high) & (low < high)).all()):
                raise ValueError(f"ActionScale: {key!r} has no finite bounds: give scale")
            return (high - low) / 2, (high + low) / 2
        for name, value in (("scale", self.scale), ("offset", self.offset)):
            if isinstance(value, Sequence):
                _check_per_dim(name, len(value), f"action {key!r}", spec)
        scale, offset = (
            torch.tensor(value, dtype=spec.dtype, device=spec.device) for value in (self.scale, self.offset)
        )
        return scale, offset

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self._buffers["scale_0"] is None:
            # The action's bounds are in the specs only.
            assert self.container is not None and self.container.input_spec is not None
        return tensordict_reset

    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        """Scale and shift."""
        scale, offset = self._buffers[f"scale_{index}"], self._buffers[f"offset_{index}"]
        if scale is None or offset is None:
            raise RuntimeError("ActionScale knows its numbers once an env holds it and has made its specs")
        return torch.addcmul(offset, value, scale)


def check_scale(field: str, scale: PerDim) -> None:
    """Refuse what is neither a finite number nor a tuple of them.

    Raises:
        ValueError: naming the field and the value.
    """
    for index, factor in enumerate(scale if isinstance(scale, tuple | list) else [scale]):
        checks.check_in_range(f"{field}[{index}]" if isinstance(scale, tuple | list) else field, factor)


def _check_per_dim(field: str, count: int, owner: str, spec: TensorSpec) -> None:
    if not len(spec.shape) or count != spec.shape[-1]:
        raise ValueError(
            f"{field} has {count} numbers, but the {owner} has shape {tuple(spec.shape)}: give 1 or one per element "
            "of the last dim"
        )
