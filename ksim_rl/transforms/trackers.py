"""The transforms of this module keep account of each episode: return, length, success, and the time that is left."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float32, Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from ksim_rl import checks
from ksim_rl.transforms import upstream
from ksim_rl.transforms.checked_keys import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.innermost import EpisodeLimit, innermost
from ksim_rl.transforms.row_transform import RowTransform
from ksim_rl.transforms.specs import leaf_spec, set_leaf_spec
from ksim_rl.transforms.tally import tally


def time_left(horizon: int, step_E: Shaped[Tensor, " E"]) -> Float32[Tensor, " E"]:
    """Return how many env steps an episode of `horizon` has left after `step_E` of them, 0 from the horizon on."""
    return (horizon - step_E).clamp_(min=0).to(torch.float32)


class _Tracker(RowTransform):
    """The base of accounts of each episode, from 0 at its reset; copies go out, as the kept ones change in place."""

    @abstractmethod
    def _kept(self) -> list[Tensor]:
        """Return the kept tensors, [E, ...], in the order of the out keys."""

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        for kept_E in self._kept():
            # A fill instead of a product: a sum that became NaN must not survive the reset.
            kept_E.masked_fill_(mask_E.reshape(-1, *[1] * (kept_E.ndim - 1)), 0)
        return self._write(tensordict_reset)

    def _write(
        self, tensordict: TensorDictBase, copies: Sequence[Tensor] | None = None
    ) -> TensorDictBase:
        batch = tensordict.batch_size
        for key, copy in zip(self.out_keys, copies or [kept_E.clone() for kept_E in self._kept()]):  # noqa: B905 (the length may have no key)
            tensordict.set(
                key, copy if len(batch) == 1 else copy.reshape((*batch, *copy.shape[1:]))
            )
        return tensordict


class EpisodeTracker(_Tracker):
    """The sum of rewards and the number of steps since the reset; where `done` is True, of the whole episode.

    Both are part of `next`, and 0 at a reset; sums have the rewards' shapes and dtypes, the number of steps (left out
    by a `length_key` of None) is int64 [E, 1]. Nothing is read by the host: take the rows that are done after a
    rollout, `rollout["next", "episode_return"][rollout["next", "done"]]`.

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
        in_keys = as_keys(in_keys)
        returns = as_keys(out_keys)
        checked_out_keys(in_keys, returns)
        # The returns first, one per reward, then the length: the order of `_kept`.
        if length_key is None:
            lengths: list[NestedKey] = []
        else:
            lengths = [length_key]
        super().__init__(in_keys, returns + lengths, is_paired=False)
        self._register_rows("step_E", *self._per_key("return"))
        self.length_key = length_key
        self._is_usual = False

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        output_spec = output_spec.clone()
        rewards = output_spec["full_reward_spec"]
        observations = output_spec["full_observation_spec"]
        leaves = [leaf_spec(rewards, key, type(self).__name__) for key in self.in_keys]
        # A sum of flags would be a flag.
        for key, spec in zip(self.in_keys, leaves, strict=True):
            if spec.dtype == torch.bool:
                raise ValueError(f"EpisodeTracker: {key!r} is {spec.dtype}: expected numbers")
        for key, spec in zip(self.out_keys, leaves, strict=False):
            set_leaf_spec(
                observations, key, Unbounded(spec.shape, dtype=spec.dtype, device=spec.device)
            )
        if self.length_key is not None:
            # int64, as episodes have no longest length.
            shape = torch.Size([*observations.shape, 1])
            spec = Unbounded(shape, dtype=torch.int64, device=observations.device)
            set_leaf_spec(observations, self.length_key, spec)
        self._size_rows(observations)
        self._size_buffer("step_E", torch.int64)
        self._size_leaves("return", observations, leaves)
        # Nearly every env has one float32 reward: it is counted in one launch.
        one = [spec.dtype for spec in leaves] == [torch.float32]
        # A nested reward may have several numbers per env, for which the launch is not made.
        self._is_usual = one and self.return_0.numel() == self.num_rows
        return output_spec

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        if self._is_usual:
            return self._tally(tensordict_reset, None, mask_E)
        return super()._begin(tensordict_reset, mask_E)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        if self._is_usual:
            return self._tally(next_tensordict, next_tensordict.get(self.in_keys[0]), None)
        # The general case: any number of rewards, in their own shapes and dtypes.
        *totals, step_E1 = self._kept()
        step_E1.add_(1)
        for key, total_E in zip(self.in_keys, totals, strict=True):
            total_E.add_(next_tensordict.get(key).reshape(total_E.shape))
        return self._write(next_tensordict)

    def _tally(
        self, tensordict: TensorDictBase, reward: Tensor | None, mask_E: Tensor | None
    ) -> TensorDictBase:
        # The dict of buffers answers much faster than the module.
        buffers: dict[str, Any] = self._buffers
        step_E, total_E = tally(buffers["step_E"], buffers["return_0"], reward, mask_E)
        return self._write(tensordict, (total_E, step_E.unsqueeze(1)))

    def _kept(self) -> list[Tensor]:
        return [
            *(getattr(self, name) for name in self._per_key("return")),
            self.step_E.unsqueeze(1),
        ]


class SuccessTracker(_Tracker):
    """Whether an episode has succeeded, bool; where `done` is True, of the whole episode.

    In keys: observations, rewards, done flags; success is above the threshold, once an episode ("any") or now ("last").

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
        checks.check_in_range("threshold", threshold)
        checks.check_choice("reduce", reduce, ("any", "last"))
        super().__init__(in_keys, out_keys)
        self._register_rows(*self._per_key("success"))
        self.threshold = threshold
        self.reduce = reduce

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        output_spec = output_spec.clone()
        observations = output_spec["full_observation_spec"]
        # Success may be read from any output of the env.
        everything = output_spec["full_done_spec"].clone()
        for part in ("full_reward_spec", "full_observation_spec"):
            everything.update(output_spec[part].clone())
        leaves = [leaf_spec(everything, key, type(self).__name__) for key in self.in_keys]
        for out_key, spec in zip(self.out_keys, leaves, strict=True):
            outcome = Binary(shape=spec.shape, dtype=torch.bool, device=observations.device)
            set_leaf_spec(observations, out_key, outcome)
        self._size_rows(observations)
        self._size_leaves("success", observations, leaves, torch.bool)
        return output_spec

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        for key, success_E in zip(self.in_keys, self._kept(), strict=True):
            now_E = (next_tensordict.get(key) > self.threshold).reshape(success_E.shape)
            # The maximum of flags is "or": once reached, it stays for the episode.
            success_E.copy_(now_E if self.reduce == "last" else torch.maximum(success_E, now_E))
        return self._write(next_tensordict)

    def _kept(self) -> list[Tensor]:
        return [getattr(self, name) for name in self._per_key("success")]


class TimeAwareObservation(_Tracker):
    """The time that is left of an episode, float32 [E, 1]: without it the value of a state is ambiguous.

    Counted in env steps from the reset that this transform saw; 0 from the horizon on. `normalize` gives the share that
    is left, from 1 to 0. See Pardo et al., "Time Limits in Reinforcement Learning" (2018). A `horizon` of None takes
    `max_episode_length` of the env, or Gymnasium's `spec.max_episode_steps`.

    Example:
        >>> clock = TimeAwareObservation(horizon=500)
    """

    step_E: Tensor

    def __init__(
        self,
        out_keys: list[NestedKey] | NestedKey = "remaining_time",
        *,
        horizon: int | None = None,
        normalize: bool = True,
    ) -> None:
        keys = as_keys(out_keys)
        if len(keys) != 1:
            raise ValueError(f"out_keys={keys}: expected one key")
        if horizon is not None:
            checks.check_count("horizon", horizon)
        super().__init__([], keys, is_paired=False)
        self._register_rows("step_E")
        self.horizon = horizon
        self.normalize = normalize

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        if self.normalize:
            high = 1.0
        else:
            high = float(self._horizon())
        shape = torch.Size([*observation_spec.shape, 1])
        spec = Bounded(0.0, high, shape, device=observation_spec.device, dtype=torch.float32)
        set_leaf_spec(observation_spec, self.out_keys[0], spec)
        self._size_rows(observation_spec)
        # float32, as the observation is; whole numbers are exact in it up to 2^24.
        self._size_buffer("step_E", torch.float32)
        return observation_spec

    def _horizon(self) -> int:
        """Return the number of env steps of an episode, and remember it."""
        # Asked for once: the answer cannot change while the env lives.
        if self.horizon is None:
            if self.container is None:
                raise ValueError(
                    "horizon=None asks the env for its horizon: use the transform in an env"
                )
            env = innermost(self.container)
            # Ours say it themselves; Gymnasium keeps it in the spec of its env.
            if isinstance(env, EpisodeLimit):
                found = env.max_episode_length
            else:
                found = upstream.gym_horizon(env)
            if not found:
                raise ValueError(
                    f"horizon=None, but the episodes of {type(env).__name__} never time out: give it"
                )
            self.horizon = int(found)
        return self.horizon

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        self.step_E.add_(1.0)
        return self._write(next_tensordict)

    def _write(
        self, tensordict: TensorDictBase, copies: Sequence[Tensor] | None = None
    ) -> TensorDictBase:
        horizon = self._horizon()
        # The remaining time is made from the count, so that only the count is kept.
        left_E1 = time_left(horizon, self.step_E).unsqueeze(1)
        return super()._write(tensordict, [left_E1 / horizon if self.normalize else left_E1])

    def _kept(self) -> list[Tensor]:
        return [self.step_E]
