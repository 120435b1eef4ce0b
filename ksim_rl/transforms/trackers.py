"""The transforms of this module keep account of each episode: its return, its length, whether it succeeded."""

from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from ksim_rl import checks
from ksim_rl.transforms.row_transform import Keys, RowTransform, as_keys, checked_out_keys
from ksim_rl.transforms.specs import Device, leaf_spec, set_leaf_spec
from ksim_rl.transforms.tally import tally


class EpisodeTracker(RowTransform):
    """The sum of rewards and the number of steps since the reset; where `done` is True, those of the whole episode.

    Both are part of `next`, and 0 at a reset. Nothing is read by the host: take the rows that are done after a rollout,
    `rollout["next", "episode_return"][rollout["next", "done"]]`.

    Args:
        in_keys: rewards; nested keys as tuples.
        out_keys: where their sums go, in the rewards' shapes and dtypes. Default: "episode_return", which needs one
            reward.
        length_key: where the number of steps goes, int64 [E, 1]; None leaves it out.

    Example:
        >>> tracker = EpisodeTracker()
    """

    step_E: Tensor
    return_0: Tensor

    def __init__(
        self,
        in_keys: Keys = "reward",
        out_keys: Keys = "episode_return",
        *,
        length_key: NestedKey | None = "episode_length",
    ) -> None:
        in_keys, returns = as_keys(in_keys), as_keys(out_keys)
        if len(in_keys) != len(returns):
            raise ValueError(
                f"out_keys={returns} has {len(returns)} keys for the {len(in_keys)} of in_keys={in_keys}"
            )
        lengths: list[NestedKey] = [] if length_key is None else [length_key]
        if len(set(returns + lengths)) != len(returns + lengths):
            raise ValueError(
                f"out_keys={returns} and length_key={length_key!r} repeat a key: each needs its own place"
            )
        buffers = ["step_E", *(f"return_{index}" for index in range(len(in_keys)))]
        super().__init__(in_keys, returns + lengths, row_buffers=buffers)
        self.length_key = length_key
        self._is_usual = False

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Add the returns, shaped as the rewards, and the lengths to the observations."""
        output_spec = output_spec.clone()
        rewards, observations = output_spec["full_reward_spec"], output_spec["full_observation_spec"]
        specs = [leaf_spec(rewards, key, type(self).__name__) for key in self.in_keys]
        self._size(
            observations.shape, [spec.shape for spec in specs], [s.dtype for s in specs], output_spec.device
        )
        for key, spec in zip(self.out_keys, specs, strict=False):
            set_leaf_spec(observations, key, Unbounded(spec.shape, dtype=spec.dtype, device=spec.device))
        if self.length_key is not None:
            shape = torch.Size([*observations.shape, 1])
            spec = Unbounded(shape, dtype=torch.int64, device=observations.device)
            set_leaf_spec(observations, self.length_key, spec)
        return output_spec

    def _size(
        self, batch: torch.Size, shapes: list[torch.Size], dtypes: list[torch.dtype], device: Device
    ) -> None:
        self._size_rows(batch.numel(), device)
        self._size_buffer("step_E", (self.num_rows,), torch.int64, device)
        for index, (shape, dtype) in enumerate(zip(shapes, dtypes, strict=True)):
            leaf = (self.num_rows, *shape[len(batch) :])
            self._size_buffer(f"return_{index}", leaf, dtype, device)
        # One float32 reward per env is what nearly every env has: it is counted in one launch.
        self._is_usual = dtypes == [torch.float32] and self.return_0.numel() == self.num_rows

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self._buffers["step_E"] is None or not self.num_rows:
            # The shapes of rewards are in the specs only.
            assert self.container is not None and self.container.output_spec is not None
        mask_E = self._reset_rows(tensordict, tensordict_reset)
        if self._is_usual:
            return self._tally(tensordict_reset, None, mask_E)
        self.step_E.masked_fill_(mask_E, 0)
        totals = self._totals()
        for total_E in totals:
            total_E.masked_fill_(mask_E.reshape(-1, *[1] * (total_E.ndim - 1)), 0)
        return self._write(tensordict_reset, self.step_E.clone(), [total_E.clone() for total_E in totals])

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._is_usual:
            return self._tally(next_tensordict, next_tensordict.get(self.in_keys[0]), None)
        self.step_E.add_(1)
        totals = self._totals()
        for key, total_E in zip(self.in_keys, totals, strict=True):
            total_E.add_(next_tensordict.get(key).reshape(total_E.shape))
        return self._write(next_tensordict, self.step_E.clone(), [total_E.clone() for total_E in totals])

    def _tally(
        self, tensordict: TensorDictBase, reward: Tensor | None, mask_E: Tensor | None
    ) -> TensorDictBase:
        # The dict of buffers answers much faster than the module.
        buffers: dict[str, Any] = self._buffers
        step_E, total_E = tally(buffers["step_E"], buffers["return_0"], reward, mask_E)
        return self._write(tensordict, step_E, [total_E])

    def _totals(self) -> list[Tensor]:
        return [getattr(self, f"return_{index}") for index in range(len(self.in_keys))]

    def _write(self, tensordict: TensorDictBase, step_E: Tensor, totals: list[Tensor]) -> TensorDictBase:
        batch = tensordict.batch_size
        for key, total_E in zip(self.out_keys, totals):  # noqa: B905 (the last key is that of the length)
            tensordict.set(key, total_E if len(batch) == 1 else total_E.reshape(*batch, *total_E.shape[1:]))
        if self.length_key is not None:
            tensordict.set(
                self.length_key, step_E.unsqueeze(1) if len(batch) == 1 else step_E.reshape(*batch, 1)
            )
        return tensordict


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
