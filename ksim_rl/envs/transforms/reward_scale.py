"""Units of rewards."""

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from ksim_rl import checks
from ksim_rl.envs.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.envs.transforms.specs import (
    add_bounds,
    bounded,
    bounds,
    leaf_spec,
    multiply_bounds,
    set_leaf_spec,
)


class RewardScale(Transform):
    """Rewards as `scale * reward + offset`.

    Args:
        in_keys: rewards; nested keys as tuples.
        out_keys: where the scaled ones go. Default: in place.
        scale, offset: finite numbers.

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
    ) -> None:
        in_keys = as_keys(in_keys)
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys))
        checks.check_in_range("scale", scale)
        checks.check_in_range("offset", offset)
        self.scale, self.offset = scale, offset

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Scale and shift the bounds."""
        specs = [leaf_spec(reward_spec, key, type(self).__name__) for key in self.in_keys]
        for out_key, spec in zip(self.out_keys, specs, strict=True):
            low, high = bounds(spec)
            factor, shift = torch.full_like(low, self.scale), torch.full_like(low, self.offset)
            low, high = add_bounds(multiply_bounds((low, high), (factor, factor)), (shift, shift))
            set_leaf_spec(reward_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        return reward_spec

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            next_tensordict.set(out_key, next_tensordict.get(key) * self.scale + self.offset)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do the same to a batch of samples."""
        return self._call(tensordict)
