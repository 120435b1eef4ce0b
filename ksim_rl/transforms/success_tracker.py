"""Which episodes succeeded."""

from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec

from ksim_rl import checks
from ksim_rl.transforms.row_transform import (
    Keys,
    RowTransform,
    as_keys,
    checked_out_keys,
)
from ksim_rl.transforms.specs import leaf_spec, set_leaf_spec


class SuccessTracker(RowTransform):
    """Whether an episode has succeeded, bool; where `done` is True, that of the whole episode.

    Args:
        in_keys: what tells success, at each step: an observation, reward or done flag; nested keys as tuples.
        out_keys: where the outcomes go, in the shapes of in_keys. Default: "episode_success", which needs one in key.
        threshold: a number above it is success; 0.5 suits flags too.
        reduce: "any" for success once, "last" for success now.

    Example:
        >>> tracker = SuccessTracker("reached_goal")
    """

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys = "episode_success",
        *,
        threshold: float = 0.5,
        reduce: Literal["any", "last"] = "any",
    ) -> None:
        in_keys = as_keys(in_keys)
        checks.check_in_range("threshold", threshold)
        checks.check_choice("reduce", reduce, ("any", "last"))
        buffers = [f"success_{index}" for index in range(len(in_keys))]
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys), row_buffers=buffers)
        self.threshold, self.reduce = threshold, reduce

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Add the outcomes to the observations."""
        output_spec = output_spec.clone()
        observations = output_spec["full_observation_spec"]
        specs = [self._spec_of(output_spec, key) for key in self.in_keys]
        batch_dims = observations.ndim
        self._size_rows(observations.shape.numel(), observations.device)
        for index, (out_key, spec) in enumerate(zip(self.out_keys, specs, strict=True)):
            leaf = spec.shape[batch_dims:]
            self._size_buffer(f"success_{index}", (self.num_rows, *leaf), torch.bool, observations.device)
            size = spec.shape[-1] if len(spec.shape) else 1
            outcome = Binary(size, shape=spec.shape, dtype=torch.bool, device=observations.device)
            set_leaf_spec(observations, out_key, outcome)
        return output_spec

    def _spec_of(self, output_spec: Composite, key: NestedKey) -> TensorSpec:
        parts = [
            output_spec[part] for part in ("full_observation_spec", "full_reward_spec", "full_done_spec")
        ]
        for part in parts:
            if key in part.keys(True, True):
                return part[key]
        everything = parts[0].clone()
        for part in parts[1:]:
            everything.update(part.clone())
        return leaf_spec(everything, key, type(self).__name__)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self._buffers["success_0"] is None or not self.num_rows:
            # The shapes of rewards are in the specs only.
            assert self.container is not None and self.container.output_spec is not None
        mask_E = self._reset_rows(tensordict, tensordict_reset)
        for index in range(len(self.in_keys)):
            success_E: Tensor = getattr(self, f"success_{index}")
            success_E.masked_fill_(mask_E.reshape(-1, *[1] * (success_E.ndim - 1)), False)
        return self._write(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for index, key in enumerate(self.in_keys):
            success_E: Tensor = getattr(self, f"success_{index}")
            now_E = (next_tensordict.get(key) > self.threshold).reshape(success_E.shape)
            success_E.copy_(success_E | now_E if self.reduce == "any" else now_E)
        return self._write(next_tensordict)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Give out copies: the kept ones change in place."""
        for index, out_key in enumerate(self.out_keys):
            success_E: Tensor = getattr(self, f"success_{index}")
            tensordict.set(out_key, success_E.clone().reshape(*tensordict.batch_size, *success_E.shape[1:]))
        return tensordict
