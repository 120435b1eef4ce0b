"""Actions are smoothed by the filter of this module."""

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from ksim_rl import checks
from ksim_rl.transforms.checked_keys import Keys
from ksim_rl.transforms.row_transform import RowTransform, checked_action


def smoothing(cutoff_hz: float, step_s: float) -> float:
    """Return alpha, the share of the way to a constant input that such a filter goes in a step of `step_s`."""
    return 1.0 - math.exp(-2.0 * math.pi * cutoff_hz * step_s)


class ActionLowPass(RowTransform):
    """The env receives `y = y + alpha * (action - y)`, a first-order low-pass filter (see `smoothing`).

    `initial` is y before the first action of an episode; None passes that action unfiltered.

    Example:
        >>> low_pass = ActionLowPass(alpha=0.3)
    """

    fresh_E: Tensor

    def __init__(
        self,
        in_keys_inv: Keys = "action",
        out_keys_inv: Keys | None = None,
        *,
        alpha: float,
        initial: float | None = None,
    ) -> None:
        checks.check_in_range("alpha", alpha, low=0.0, high=1.0, low_open=True)
        if initial is not None:
            checks.check_in_range("initial", initial)
        super().__init__(in_keys_inv=in_keys_inv, out_keys_inv=out_keys_inv)
        self._register_rows("fresh_E", *self._per_key("filtered"))
        self.alpha = alpha
        self.initial = initial

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        leaves = self._replace_leaves(action_spec, is_inverse=True, is_floating=True)
        self._size_rows(action_spec)
        self._size_buffer("fresh_E", torch.bool)
        self._size_leaves("filtered", action_spec, leaves)
        return action_spec

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        # Only marked here: the first action is not known before the first step.
        self.fresh_E.logical_or_(mask_E)
        return tensordict_reset

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        for index, (key, out_key) in enumerate(
            zip(self.in_keys_inv, self.out_keys_inv, strict=True)
        ):
            filtered_E: Tensor = getattr(self, f"filtered_{index}")
            action = checked_action(tensordict, out_key, filtered_E.shape[1:], filtered_E.dtype)
            action_E = action.reshape(filtered_E.shape)
            fresh_E = self.fresh_E.reshape(-1, *[1] * (action_E.ndim - 1))
            # A fresh filter that begins at the action lets it through unchanged.
            if self.initial is None:
                before_E = action_E
            else:
                before_E = self.initial
            filtered_E.copy_(torch.where(fresh_E, before_E, filtered_E)).lerp_(action_E, self.alpha)
            # A copy: the kept one changes in place.
            tensordict.set(key, filtered_E.clone().reshape(action.shape))
        # After all keys, which share the flags.
        self.fresh_E.zero_()
        return tensordict
