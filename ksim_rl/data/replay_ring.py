"""This module has the replay of off-policy learning: it holds the last env states of each env."""

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Int64
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ReplayBuffer

from ksim_rl import dims
from ksim_rl.data.priority_sampler import PrioritySampler
from ksim_rl.data.replay_cfg import ReplayCfg
from ksim_rl.data.replay_sampler import ReplaySampler
from ksim_rl.data.replay_storage import ReplayStorage, ReplayWriter


class ReplayRing(ReplayBuffer):
    """Holds the last env states of each env and yields minibatches of B of them, with what follows n steps later.

    Its TorchRL parts are `ReplayStorage`, `ReplaySampler` or `PrioritySampler`, and `ReplayWriter`. `extend`
    takes rollouts `["E","T"]`. None of its methods makes a host sync, so all can be captured in a CUDA graph.

    Args:
        cfg: sizes of the ring and its minibatches.
        num_envs: E.
        observations: the keys that are observed, each stored once.
        gamma: discount per step, of rewards summed over several steps.
        device: where the ring lives.
    """

    def __init__(
        self,
        cfg: ReplayCfg,
        *,
        num_envs: int,
        observations: list[NestedKey],
        gamma: float = 0.99,
        device: torch.device | str = "cpu",
    ) -> None:
        self._ring = ReplayStorage(
            num_envs=num_envs,
            capacity=cfg.capacity,
            observations=observations,
            n_step=cfg.n_step,
            gamma=gamma,
            device=device,
        )
        priorities = PrioritySampler(
            self._ring.max_size, alpha=cfg.priority_alpha, beta=cfg.priority_beta, device=device
        )
        super().__init__(
            storage=self._ring,
            sampler=priorities if cfg.prioritized else ReplaySampler(),
            writer=ReplayWriter(),
            collate_fn=_as_it_is,
            batch_size=cfg.num_env_states_per_minibatch,
        )
        self.cfg = cfg

    @property
    def non_finite_count(self) -> Int64[Tensor, ""]:
        """Env states refused so far because an element was not finite, on the device."""
        return self._ring.non_finite_count

    @property
    def num_stored(self) -> Int64[Tensor, ""]:
        """Env states that are stored, on the device."""
        return self._ring.available.sum()

    def minibatches(self, count: int) -> Iterator[TensorDictBase]:
        """Yield `count` minibatches `["B"]`.

        With priorities they have "priority_weight" and "index", and each is drawn when it is asked for, by the
        priorities of that moment.
        """
        if not self.cfg.prioritized:
            # One gather for all minibatches: a fraction of the kernels.
            data, _ = self._sample(count * self.cfg.num_env_states_per_minibatch)
            for minibatch_B in data.split(self.cfg.num_env_states_per_minibatch):
                yield dims.name(minibatch_B, dims.B)
            return
        for _ in range(count):
            minibatch_B, info = self._sample(self.cfg.num_env_states_per_minibatch)
            minibatch_B.set("priority_weight", info["priority_weight"][:, None])
            minibatch_B.set("index", info["index"])
            yield minibatch_B

    def state_dict(self) -> dict[str, Any]:
        """Return the ring, and the priorities where there are any; without `save_replay` nothing."""
        if not self.cfg.save_replay:
            return {}
        return {"ring": self._ring.state_dict(), "sampler": self._sampler.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken; an empty one empties the ring."""
        if not state_dict:
            self.empty()
            return
        self._ring.load_state_dict(state_dict["ring"])
        self._sampler.load_state_dict(state_dict["sampler"])


def _as_it_is(data: TensorDictBase) -> TensorDictBase:
    return data
