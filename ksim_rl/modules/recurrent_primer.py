"""This module has the transforms with which an env carries the state of a recurrent network."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs import EnvBase, InitTracker
from torchrl.envs.transforms import TensorDictPrimer, Transform


class RecurrentStatePrimer(TensorDictPrimer):
    """TorchRL's primer, free of host syncs: each episode begins with zeros, each step goes on with what was written.

    Rows that do not reset keep their values.

    Args:
        primers: specs of the state of one env, each [N, H].
    """

    def __init__(self, primers: Composite) -> None:
        super().__init__(primers, expand_specs=True)
        self.state_keys: list[Any] = list(primers.keys(True, True))

    def _reset_func(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> Any:
        mask = None if tensordict is None else tensordict.get(self.reset_key, None)
        for key in self.state_keys:
            zero = self.primers[key].zero()  # pyright: ignore[reportOptionalSubscript]
            before = None if tensordict is None else tensordict.get(key, None)
            if mask is not None and before is not None:
                zero = torch.where(mask.reshape(*zero.shape[:-2], 1, 1), zero, before)
            tensordict_reset.set(key, zero)
        return tensordict_reset


def recurrent_transforms(env: EnvBase, *primers: TensorDictPrimer) -> list[Transform]:
    """Return what an env needs to carry recurrent states: `is_init` where it has none yet, and the primers.

    Example:
        >>> for transform in recurrent_transforms(env, memory.make_tensordict_primer()):
        ...     env.append_transform(transform)
    """
    tracker = [] if "is_init" in env.observation_spec.keys() else [InitTracker()]
    return [*tracker, *primers]
