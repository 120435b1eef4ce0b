"""Returns and lengths of episodes."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from ksim_rl.envs.transforms.row_transform import Keys, RowTransform, as_keys
from ksim_rl.envs.transforms.specs import Device, leaf_spec, set_leaf_spec


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

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self._buffers["step_E"] is None or not self.num_rows:
            # The shapes of rewards are in the specs only.
            assert self.container is not None and self.container.output_spec is not None
        mask_E = self._reset_rows(tensordict, tensordict_reset)
        self.step_E.masked_fill_(mask_E, 0)
        for index in range(len(self.in_keys)):
            return_E: Tensor = getattr(self, f"return_{index}")
            return_E.masked_fill_(mask_E.reshape(-1, *[1] * (return_E.ndim - 1)), 0)
        return self._write(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.step_E.add_(1)
        for index, key in enumerate(self.in_keys):
            return_E: Tensor = getattr(self, f"return_{index}")
            return_E.add_(next_tensordict.get(key).reshape(return_E.shape))
        return self._write(next_tensordict)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Give out copies: the kept ones change in place."""
        batch = tensordict.batch_size
        for index in range(len(self.in_keys)):
            return_E: Tensor = getattr(self, f"return_{index}")
            tensordict.set(self.out_keys[index], return_E.clone().reshape(*batch, *return_E.shape[1:]))
        if self.length_key is not None:
            tensordict.set(self.length_key, self.step_E.clone().reshape(*batch, 1))
        return tensordict
