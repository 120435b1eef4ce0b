"""A policy of finite episodes sees the time that is left by the transform of this module."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite

from ksim_rl.transforms.innermost import innermost
from ksim_rl.transforms.row_transform import RowTransform, as_keys
from ksim_rl.transforms.specs import set_leaf_spec
from ksim_rl.transforms.tally import count_down


class TimeAwareObservation(RowTransform):
    """The time that is left of an episode, float32 [E, 1]: without it the value of a state is ambiguous.

    Counted in env steps from the reset that this transform saw; 0 from the horizon on. See Pardo et al., "Time Limits
    in Reinforcement Learning" (2018).

    Args:
        out_keys: the one key to write.
        horizon: env steps of an episode. None takes `max_episode_length` of the env, or Gymnasium's
            `spec.max_episode_steps`.
        normalize: True gives the share that is left, from 1 to 0; False gives env steps.

    Example:
        >>> clock = TimeAwareObservation(horizon=500)
    """

    left_E: Tensor

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
        if horizon is not None and (isinstance(horizon, bool) or not isinstance(horizon, int) or horizon < 1):
            raise ValueError(f"horizon={horizon!r}: expected a whole number of env steps of at least 1")
        super().__init__([], keys, row_buffers=["left_E"])
        self.horizon, self.normalize = horizon, normalize

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the clock, between 0 and 1, or 0 and the horizon."""
        high = 1.0 if self.normalize else float(self._horizon())
        shape = torch.Size([*observation_spec.shape, 1])
        spec = Bounded(0.0, high, shape, device=observation_spec.device, dtype=torch.float32)
        set_leaf_spec(observation_spec, self.out_keys[0], spec)
        self._size_rows(observation_spec.shape.numel(), observation_spec.device)
        self._size_buffer("left_E", (self.num_rows,), torch.float32, observation_spec.device)
        return observation_spec

    def _horizon(self) -> int:
        """Return the number of env steps of an episode, and remember it."""
        if self.horizon is None:
            if self.container is None:
                raise ValueError("horizon=None asks the env for its horizon: use the transform in an env")
            env = innermost(self.container)
            gym_spec = getattr(getattr(env, "_env", None), "spec", None)
            found = getattr(env, "max_episode_length", None) or getattr(gym_spec, "max_episode_steps", None)
            if not found:
                raise ValueError(
                    f"horizon=None, but the episodes of {type(env).__name__} never time out: give it"
                )
            self.horizon = int(found)
        return self.horizon

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self._buffers["left_E"] is None or not self.num_rows:
            self._size_rows(tensordict_reset.numel(), tensordict_reset.device)
            self._size_buffer("left_E", (self.num_rows,), torch.float32, tensordict_reset.device)
        return self._count(tensordict_reset, self._reset_rows(tensordict, tensordict_reset))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._count(next_tensordict, None)

    def _count(self, tensordict: TensorDictBase, mask_E: Tensor | None) -> TensorDictBase:
        horizon = float(self._horizon())
        left_E = count_down(self.left_E, mask_E, horizon, horizon if self.normalize else 1.0)
        return tensordict.set(self.out_keys[0], left_E.reshape(*tensordict.batch_size, 1))
