"""Observations are normalized by running statistics, by the transform of this module."""

from copy import deepcopy
from typing import Self

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded

from ksim_rl import checks, ranks
from ksim_rl.ranks.running_moments import RunningMoments, publish
from ksim_rl.transforms import upstream
from ksim_rl.transforms.checked_keys import Keys
from ksim_rl.transforms.row_transform import RowTransform
from ksim_rl.transforms.specs import Device


class ObservationNormalization(RowTransform):
    """Observations as `(x - mean) / sqrt(var + eps)`, with the exact mean and variance of all env states so far.

    Each env state counts once: the one that a step reaches at that step, and a reset observation at its reset, for the
    rows that reset. Statistics are per element and float64 (`RunningMoments`); states that are not finite do not count.
    After `until` env states (of all ranks) they stay. The default `eps` bounds the standard deviation below by 0.01.

    `env.eval()` freezes the statistics and `env.train()` goes on, `enable_` does the same for one transform; both write
    a device flag, so a captured or compiled step follows. With `torch.distributed`, the ranks merge their statistics in
    each step (one collective, none while frozen), so they have to step alike; states of resets join in the next step's.

    Prefer `obs_normalization` of actor and critic where they fit: those go into the checkpoint by themselves.

    Example:
        >>> normalization = ObservationNormalization(["joint_pos", "joint_vel"])
    """

    updating: Tensor

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        eps: float = 1e-4,
        until: int | None = None,
        enabled: bool = True,
    ) -> None:
        checks.check_in_range("eps", eps, low=0.0, low_open=True)
        if until is not None:
            checks.check_in_range("until", until, low=1)
        super().__init__(in_keys, out_keys)
        self.eps = eps
        self.until = until
        # The host has to know whether ranks merge in this step, as all of them have to call a collective.
        self._wanted = self._collective = enabled
        self.moments = nn.ModuleList()
        self.register_buffer("updating", torch.tensor(enabled), persistent=False)

    def enable_(self, enabled: bool = True) -> Self:
        """Update the statistics or freeze them, in place."""
        self._wanted = self._collective = enabled
        self.updating.fill_(enabled)
        return self

    def train(self, mode: bool = True) -> Self:
        """Follow the mode of the env: statistics are taken in training only."""
        super().train(mode)
        # TorchRL calls `eval()` while it attaches a transform, which is no wish to freeze.
        if upstream.is_in_env(self):
            self._collective = self._wanted and mode
            self.updating.fill_(self._collective)
        return self

    def clone(self) -> Self:
        """Copy, statistics included."""
        copy = super().clone()
        copy._modules = {**self._modules, "moments": deepcopy(self.moments)}
        return copy

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        leaves = self._replace_leaves(
            observation_spec,
            lambda _index, spec: Unbounded(spec.shape, dtype=spec.dtype, device=spec.device),
            is_floating=True,
        )
        self._size_rows(observation_spec)
        # Statistics are per element, whatever the shape of the leaf.
        sizes = [leaf.shape[observation_spec.ndim :].numel() for leaf in leaves]
        self._size_moments(sizes, observation_spec.device)
        return observation_spec

    def _size_moments(self, sizes: list[int], device: Device) -> None:
        # Statistics of the same sizes are kept: specs are made more than once.
        if [moments.dim for moments in self._each_moments()] != sizes:
            self.moments = nn.ModuleList(
                RunningMoments(n, until=self.until, device=device) for n in sizes
            )

    def _each_moments(self) -> list[RunningMoments]:
        return list(self.moments)  # pyright: ignore[reportReturnType]

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        for values_EL, moments in self._flat(tensordict_reset, self.num_rows):
            # Counted before they are normalized, so that the first observation has statistics, too.
            moments.count_rows(values_EL, mask_E & self.updating)
        # Ranks reset at different times, so they cannot merge here.
        if ranks.size() == 1:
            publish(self._each_moments())
        return self._normalize(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        for values_EL, moments in self._flat(next_tensordict, self.num_rows):
            moments.count_rows(values_EL, self.updating.expand(self.num_rows))
        if self._collective or ranks.size() == 1:
            publish(self._each_moments())
        return self._normalize(next_tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Normalize a batch of samples by the statistics as they are."""
        if not len(self.moments):
            raise RuntimeError(
                "there are no statistics yet: an env, or `load_state_dict`, gives them"
            )
        self._check_samples(tensordict)
        return self._normalize(tensordict)

    def _flat(
        self, tensordict: TensorDictBase, num_rows: int
    ) -> list[tuple[Tensor, RunningMoments]]:
        values = [tensordict.get(key).reshape(num_rows, -1) for key in self.in_keys]
        return list(zip(values, self._each_moments(), strict=True))

    def _normalize(self, tensordict: TensorDictBase) -> TensorDictBase:
        num_rows = tensordict.numel()
        leaves = self._flat(tensordict, num_rows)
        for out_key, key, leaf in zip(self.out_keys, self.in_keys, leaves, strict=True):
            values_EL, moments = leaf
            value = tensordict.get(key)
            # Statistics are float64; the leaf keeps its dtype.
            normalized_EL = moments.normalized(values_EL, self.eps)
            tensordict.set(out_key, normalized_EL.reshape(value.shape).to(value.dtype))
        return tensordict

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *args: object) -> None:
        # Children are loaded after their parent: those that no env has sized yet are made here.
        sizes = []
        while f"{prefix}moments.{len(sizes)}.mean" in state_dict:
            sizes.append(state_dict[f"{prefix}moments.{len(sizes)}.mean"].shape[0])
        if sizes and not len(self.moments):
            self._size_moments(sizes, self.updating.device)
        super()._load_from_state_dict(state_dict, prefix, *args)
