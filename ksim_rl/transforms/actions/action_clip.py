"""Limits on actions."""

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from ksim_rl.transforms.clip import Range, check_clip
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import drop_leaf_spec, leaf_spec, set_leaf_spec


class ActionClip(Transform):
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
        keys = as_keys(in_keys_inv)
        super().__init__(in_keys_inv=keys, out_keys_inv=checked_out_keys(keys, out_keys_inv))
        check_clip("clip", clip)
        self.clip = clip

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Remove the bounds."""
        specs = [leaf_spec(action_spec, key, type(self).__name__) for key in self.in_keys_inv]
        for key, out_key, spec in zip(self.in_keys_inv, self.out_keys_inv, specs, strict=True):
            if key != out_key:
                drop_leaf_spec(action_spec, key)
            set_leaf_spec(action_spec, out_key, Unbounded(spec.shape, dtype=spec.dtype, device=spec.device))
        return action_spec

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        for key, out_key in zip(self.in_keys_inv, self.out_keys_inv, strict=True):
            tensordict.set(key, torch.clamp(tensordict.get(out_key), *self.clip))
        return tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leave a batch of samples as it is: they hold the actions that the policy chose."""
        return tensordict
