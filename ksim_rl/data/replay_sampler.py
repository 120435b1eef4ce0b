"""This module samples a replay uniformly, on the device."""

from typing import Any

import torch
from torchrl.data.replay_buffers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from ksim_rl.checks import check_count
from ksim_rl.data.replay_storage import ReplayStorage


class ReplaySampler(Sampler):
    """Draws env states of a `ReplayStorage`, each with the same probability, with replacement.

    A place is drawn among all that may hold an env state. Those that do not (terminal observations, env states that are
    not finite) are drawn again, up to `tries` times; what is left then is masked. The first that holds one is taken, so
    what is drawn is exactly uniform over the env states. Makes no host sync; numbers come from torch's default
    generator of the device.

    Args:
        tries: with a share q of such places, a share q^tries of a minibatch is masked.
    """

    def __init__(self, *, tries: int = 4) -> None:
        check_count("tries", tries)
        self.tries = tries

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict]:
        """Return indices [B] and an empty info dict."""
        assert isinstance(storage, ReplayStorage)
        shape, device = (self.tries, batch_size), storage.device
        env = torch.randint(storage.num_envs, shape, device=device)
        # float64: float32 cannot tell the places of a ring of more than 2^24.
        unit = torch.rand(shape, dtype=torch.float64, device=device)
        age = 1 + (unit * storage.max_age.clamp_min(1)).to(torch.int64)
        index = storage.index(env, age)
        first = storage.available[index].to(torch.uint8).argmax(0, keepdim=True)
        return index.gather(0, first).squeeze(0), {}

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: the numbers are those of torch's default generator."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Read nothing."""

    def dumps(self, path: Any) -> None:
        """Write nothing."""

    def loads(self, path: Any) -> None:
        """Read nothing."""

    def _empty(self) -> None:
        """Forget nothing."""
