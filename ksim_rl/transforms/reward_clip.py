"""Limits on rewards."""

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from ksim_rl.transforms.clip import Range, check_clip
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import (
    bounded,
    bounds,
    floating_spec,
    set_leaf_spec,
)


class RewardClip(Transform):
    """Clip rewards to [low, high]; NaN stays NaN.

    Args:
        in_keys: rewards; nested keys as tuples.
        out_keys: where the clipped ones go. Default: in place.
        clip: (low, high); None is no limit on that side.

    Example:
        >>> clip = RewardClip(clip=(0.0, None))
    """

    def __init__(self, in_keys: Keys = "reward", out_keys: Keys | None = None, *, clip: Range) -> None:
        in_keys = as_keys(in_keys)
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys))
        check_clip("clip", clip)
        self.clip = clip

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Narrow the bounds."""
        specs = [floating_spec(reward_spec, key, type(self).__name__) for key in self.in_keys]
        for out_key, spec in zip(self.out_keys, specs, strict=True):
            low, high = (end.clamp(*self.clip) for end in bounds(spec))
            set_leaf_spec(reward_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        return reward_spec

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            next_tensordict.set(out_key, torch.clamp(next_tensordict.get(key), *self.clip))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do the same to a batch of samples."""
        return self._call(tensordict)
