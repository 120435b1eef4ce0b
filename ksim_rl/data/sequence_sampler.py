"""This module samples contiguous sequences of an env, for recurrent networks."""

from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from ksim_rl.data.dataset_storage import MASK_KEY
from ksim_rl.data.epoch_sampler import EpochSampler

BURN_IN_KEY = "burn_in"


class SequenceSampler(EpochSampler):
    """Yields sequences of L successive steps of one env, each once per epoch, in a new random order each epoch.

    A rollout of T steps is cut into T / L sequences, so each epoch has every env state exactly once. The indices are
    [S, L], S the sequences of a minibatch, and so is what a buffer returns. The state that a recurrent network begins a
    sequence with is the one stored with its first step.

    With a burn-in of k the indices are [S, k + L]: the k steps before each sequence come with it, so that a network can
    renew its state from the one stored there (Kapturowski et al., "Recurrent experience replay in distributed
    reinforcement learning", 2019). A rollout's first sequence has none before it: its first step stands there k times.
    The info has ("collector", "mask"), False where TorchRL's losses must look away, and "burn_in", True at the steps
    that renew the state, both [S, k + L, 1].

    Storages have two dims, [T, E], as TorchRL's with `ndim=2` keep rollouts [E, T]; or one, in which the steps of each
    env follow each other (`DatasetBuffer`). A `batch_size` counts env states without burn-in: S * L.

    Args:
        sequence_length: L, a divisor of T; None is T.
        burn_in: k, at most L.
        rollout_length: T, for a storage of one dim; `DatasetBuffer` sets it.
        seed, shuffle: as in `EpochSampler`.
    """

    def __init__(
        self,
        *,
        sequence_length: int | None = None,
        burn_in: int = 0,
        rollout_length: int | None = None,
        seed: int = 0,
        shuffle: bool = True,
    ) -> None:
        super().__init__(seed=seed, shuffle=shuffle)
        self.sequence_length, self.burn_in, self.rollout_length = sequence_length, burn_in, rollout_length

    def begin(self, batch_size_ET: torch.Size, *, batch_size: int) -> None:
        """Take T from a rollout that a storage of one dim takes in, and check the sizes before anything is sampled.

        Raises:
            ValueError: if the data is no rollout [E, T], or the sequences do not fit; the message has the numbers.
        """
        if len(batch_size_ET) != 2:
            raise ValueError(
                f"sequences are cut from a rollout [E, T]; the data has the dims {tuple(batch_size_ET)}"
            )
        self.rollout_length = batch_size_ET[1]
        sequence_length(
            self.rollout_length, self.sequence_length, batch_size=batch_size, burn_in=self.burn_in
        )

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict]:
        """Return the indices [S, k + L] of the next minibatch, and the info dict, which is empty without burn-in.

        Raises:
            ValueError: if the sequences fit neither the rollout nor the minibatch; the message has the numbers.
        """
        size = len(storage)  # type: ignore[arg-type]
        if size == 0:
            raise RuntimeError("the replay buffer is empty: extend it before sampling")
        steps = storage.shape[0] if storage.ndim > 1 else self.rollout_length
        if steps is None:
            raise ValueError("the storage has one dim: pass rollout_length, the steps of each env in it")
        if size % steps:
            raise ValueError(
                f"the storage has {size} env states: no whole number of rollouts of {steps} steps"
            )
        length = sequence_length(steps, self.sequence_length, batch_size=batch_size, burn_in=self.burn_in)
        device = torch.device(getattr(storage, "device", None) or "cpu")
        sequence_S = self._next_part(size // length, batch_size // length, device)
        # Within a rollout; negative where there is nothing before it.
        offset_T = torch.arange(-self.burn_in, length, device=device)
        step_ST = (sequence_S * length % steps)[:, None] + offset_T
        rollout_S1 = (sequence_S * length // steps)[:, None]
        clamped_ST = step_ST.clamp_min(0)
        index: Any = rollout_S1 * steps + clamped_ST
        if storage.ndim > 1:
            index = (clamped_ST, rollout_S1.expand_as(clamped_ST))
        return index, self._info(step_ST, offset_T)

    def _info(self, step_ST: Tensor, offset_T: Tensor) -> dict[Any, Tensor]:
        if not self.burn_in:
            return {}
        before_T = offset_T < 0
        return {
            MASK_KEY: (~before_T).expand_as(step_ST).unsqueeze(-1),
            BURN_IN_KEY: (before_T & (step_ST >= 0)).unsqueeze(-1),
        }


def sequence_length(
    rollout_length: int, length: int | None = None, *, batch_size: int, burn_in: int = 0
) -> int:
    """Return L, the steps of a training sequence, for rollouts of T steps and minibatches of so many env states.

    Args:
        length: what was asked for; None is T.

    Raises:
        ValueError: if T or the minibatch is no multiple of L, or the burn-in is longer than L.
    """
    length = rollout_length if length is None else length
    if rollout_length % length:
        raise ValueError(
            f"sequence_length={length}: rollouts have {rollout_length} steps, which are no whole number of such "
            "sequences; use a divisor of that"
        )
    if batch_size % length:
        raise ValueError(
            f"sequence_length={length}: num_env_states_per_minibatch={batch_size} is no whole number of such sequences "
            f"({batch_size / length:.4g}); use a multiple of {length} there, another number of envs, or a divisor of "
            f"{batch_size} and {rollout_length} here"
        )
    if burn_in > length:
        raise ValueError(f"burn_in={burn_in} is longer than sequence_length={length}: use at most {length}")
    return length
