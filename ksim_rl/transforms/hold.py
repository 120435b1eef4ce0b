"""Sensors that are slower than the control, and miss readings, show their last one by the transform of this module."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite

from ksim_rl.checked import Count, Share, check_value
from ksim_rl.device import random
from ksim_rl.transforms.checked_keys import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.row_transform import KeyedTransform
from ksim_rl.transforms.specs import set_leaf_spec


class ObservationHold(KeyedTransform):
    """Observations that arrive `every` few env steps only, and sometimes not at all; between them the last one stays.

    A reset shows its own observation. In each episode the first one after it arrives after 1 to `every` steps, drawn
    per env, since cameras do not wait for robots. A `dropped` share of those that are due is lost. `fresh_key` gets 1
    where the observation is of this step and 0 where it is an older one, float32 [E, 1]. All keys of one transform
    arrive together, in any dtype and without copies of another; a camera's lag is an `ObservationDelay` behind it, of
    these keys and the flag.

    Example:
        >>> camera = ObservationHold("rgb", every=3, dropped=0.1, fresh_key="rgb_fresh")
    """

    purposes = ("step/dropped", "reset/phase")

    age_E: Tensor

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        every: int = 1,
        dropped: float = 0.0,
        fresh_key: NestedKey | None = None,
        seed: int | None = None,
        stream: str | None = None,
    ) -> None:
        check_value("every", every, Count)
        check_value("dropped", dropped, Share)
        if every == 1 and dropped == 0.0:
            raise ValueError("every=1, dropped=0.0: nothing would be held")
        in_keys = as_keys(in_keys)
        shown = checked_out_keys(in_keys, out_keys)
        flags = [] if fresh_key is None else [fresh_key]
        # The flag is one for all keys.
        super().__init__(in_keys, [*shown, *flags], is_paired=False, seed=seed, stream=stream)
        self.every = every
        self.dropped = dropped
        self.fresh_key = fresh_key
        self._register_rows("age_E", *self._per_key("held"))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        leaves = self._replace_leaves(observation_spec)
        self._size_rows(observation_spec)
        self._size_buffer("age_E", torch.int64)
        self._size_leaves("held", observation_spec, leaves)
        if self.fresh_key is not None:
            shape = torch.Size([*observation_spec.shape, 1])
            flag = Bounded(0.0, 1.0, shape, device=observation_spec.device)
            set_leaf_spec(observation_spec, self.fresh_key, flag)
        return observation_spec

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        self.age_E.masked_fill_(mask_E, 0)
        return self._show(tensordict_reset, mask_E)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        self.step_count.add_(1)
        self.age_E.add_(1)
        due_E = torch.ones_like(self.age_E, dtype=torch.bool)
        if self.every > 1:
            # A function of the episode, which needs no memory.
            phase_E = random.integers(self._reset_keys("reset/phase"), 1, 1, self.every)[:, 0]
            due_E = (self.age_E - phase_E) % self.every == 0
        if self.dropped:
            chance_E = random.uniform(self._step_keys("step/dropped"), 1)[:, 0]
            due_E = due_E & (chance_E >= self.dropped)
        return self._show(next_tensordict, due_E)

    def _show(self, tensordict: TensorDictBase, arrives_E: Tensor) -> TensorDictBase:
        """Write new observations in the rows where they arrive, and the held ones in the others."""
        for index, key in enumerate(self.in_keys):
            value = tensordict.get(key)
            held_E: Tensor = getattr(self, f"held_{index}")
            arrives = arrives_E.reshape(-1, *[1] * (held_E.ndim - 1))
            shown_E = torch.where(arrives, value.reshape(held_E.shape), held_E)
            held_E.copy_(shown_E)
            tensordict.set(self.out_keys[index], shown_E.view(value.shape))
        if self.fresh_key is not None:
            fresh = arrives_E.float().reshape(*tensordict.batch_size, 1)
            tensordict.set(self.fresh_key, fresh)
        return tensordict
