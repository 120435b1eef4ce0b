"""Units of rewards."""

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite

from ksim_rl import checks
from ksim_rl.transforms.level import FollowsLevel
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import (
    add_bounds,
    bounded,
    bounds,
    floating_spec,
    multiply_bounds,
    set_leaf_spec,
)


class RewardScale(FollowsLevel):
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
        in_keys = as_keys(in_keys)
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys))
        checks.check_in_range("scale", scale)
        checks.check_in_range("offset", offset)
        if first_scale is not None:
            checks.check_in_range("first_scale", first_scale)
        self.scale, self.offset, self.first_scale = scale, offset, first_scale
        self._register_level(is_used=first_scale is not None)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Scale and shift the bounds."""
        specs = [floating_spec(reward_spec, key, type(self).__name__) for key in self.in_keys]
        for out_key, spec in zip(self.out_keys, specs, strict=True):
            low, high = bounds(spec)
            scales = self.scale, self.scale if self.first_scale is None else self.first_scale
            factors = torch.full_like(low, min(scales)), torch.full_like(low, max(scales))
            shift = torch.full_like(low, self.offset)
            low, high = add_bounds(multiply_bounds((low, high), factors), (shift, shift))
            set_leaf_spec(reward_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        return reward_spec

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        scale = self.scale
        if self.first_scale is not None:
            scale = self.first_scale + (self.scale - self.first_scale) * self.level
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            scaled = next_tensordict.get(key) * scale
            next_tensordict.set(out_key, scaled + self.offset if self.offset else scaled)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do the same to a batch of samples."""
        return self._call(tensordict)
