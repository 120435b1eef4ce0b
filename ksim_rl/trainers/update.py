"""What the trainer asks of an algorithm."""

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ksim_rl.device.state_tree import State


class Update(Protocol):
    """Improves a policy with one rollout at a time. `PPOUpdate` and its siblings are such; so may be a class of yours.

    Attributes:
        device: where all of it lives.
        actor: the policy that is evaluated, recorded and saved.
        behavior: the policy that collects; often the actor itself.
        num_env_states: how many env states a rollout has, E * T.
    """

    device: torch.device

    @property
    def actor(self) -> TensorDictModuleBase:
        """The policy that is evaluated, recorded and saved."""
        ...

    @property
    def behavior(self) -> TensorDictModuleBase:
        """The policy that collects."""
        ...

    @property
    def num_env_states(self) -> int:
        """Env states of one rollout, E * T."""
        ...

    @property
    def rollout_keys(self) -> list[Any]:
        """The leaves of an env state that an update reads."""
        ...

    def __call__(self, rollout_ET: TensorDictBase) -> None:
        """Learn from a rollout `["E","T"]`, without a host sync; on CUDA it is the same memory at each call."""

    def metrics(self) -> dict[str, Tensor]:
        """Return what the last update measured, each a tensor [] on the device, `update/skipped_steps` among them."""
        ...

    def check(self, metrics: Mapping[str, float]) -> None:
        """Raise where `metrics`, read on the host, say that the run cannot go on."""

    def state_dict(self) -> State:
        """Return everything that the next update depends on."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where `state_dict` was taken; tensors keep their addresses."""

    def load_weights(self, state: Mapping[str, Any]) -> None:
        """Take only the networks of a `state_dict`: a new run that starts from them."""
