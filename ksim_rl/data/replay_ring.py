"""This module has the replay of off-policy learning: it holds the last env states of each env."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Int64
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ReplayBuffer

from ksim_rl import dims
from ksim_rl.checked import Checked, Count, NonNegative, Share
from ksim_rl.data.replay_samplers import PrioritySampler, ReplaySampler
from ksim_rl.data.replay_storage import ReplayStorage, ReplayWriter


@dataclass(frozen=True, kw_only=True)
class ReplayCfg(Checked):
    """How many env states a rollout adds to the replay, how many it keeps, and how many a gradient step sees.

    One iteration is `num_steps` steps of each env and then `num_minibatches` gradient steps, so that there are
    `num_minibatches / num_steps` gradient steps per step. The recipe of FastTD3 alternates 1 step and u gradient steps;
    T steps and then T * u gradient steps is the same but for actions that are up to T - 1 steps older than the newest
    policy, and each iteration is only two graphs, whatever T is.

    Attributes:
        num_env_states_per_minibatch: B, env states in one gradient step.
        num_minibatches: gradient steps per iteration.
        num_steps: T, steps of each env per iteration.
        capacity: env states that are kept per env. An episode's end takes one more, for its terminal observation.
        n_step: rewards that a target sums before it bootstraps.
        learning_starts: steps of each env with random actions before the first gradient step.
        prioritized: draw env states by their last temporal-difference error (Schaul et al., arXiv 1511.05952) and not
            uniformly.
        priority_alpha: how strongly the error counts; 0 is uniform.
        priority_beta: how far the weights of the losses undo that; 1 is wholly.
        save_replay: keep the env states in checkpoints. Without, checkpoints are small and a resumed run begins with
            an empty replay and random actions until `learning_starts`, so that it is not the same run any more.
    """

    num_env_states_per_minibatch: Count
    num_minibatches: Count
    num_steps: Count = 1
    capacity: Count = 1024
    n_step: Count = 1
    learning_starts: Count = 10
    prioritized: bool = False
    priority_alpha: NonNegative = 0.6
    priority_beta: Share = 0.4
    save_replay: bool = True

    def __post_init__(self) -> None:
        """Refuse a ring that is too small for its rollouts."""
        super().__post_init__()
        # A rollout whose episodes all end at once takes two places per env state, and must not overwrite itself.
        least = 2 * self.num_steps + self.n_step
        if self.capacity < least:
            raise ValueError(
                f"capacity={self.capacity} is less than 2 * num_steps + n_step = {least}: "
                "one rollout would overwrite itself; raise capacity"
            )

    def rollout_length(self, num_envs: int) -> int:
        """Return T, which does not depend on the number of envs."""
        return self.num_steps


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
            collate_fn=lambda data: data,
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
