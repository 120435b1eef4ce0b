"""Stores one dataset in place, and lets no non-finite number in."""

from collections.abc import Iterable
from os import PathLike
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Int64, Shaped
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers import Writer
from torchrl.data.replay_buffers.storages import TensorStorage

from ksim_rl import dims
from ksim_rl.device.state_tree import State, tensor


class Stateless:
    """The part of TorchRL writers and samplers that have no state: all that they know is in the storage."""

    def state_dict(self) -> State:
        """Return nothing."""
        return {}

    def load_state_dict(self, state_dict: State) -> None:
        """Read nothing."""

    def dumps(self, path: str | PathLike[str]) -> None:
        """Write nothing, as `loads` reads nothing."""

    loads = dumps

    def _empty(self, empty_write_count: bool = True) -> None:
        """Forget nothing."""


# Where TorchRL's losses look for rows to leave out (`LossModule.loss_mask_key`), stock ones included.
MASK_KEY = ("collector", "mask")


class DatasetStorage(TensorStorage):
    """A TorchRL storage of D env states that are always written together, in place.

    The first write allocates it; later ones copy into the same addresses, so that a captured update stays valid.

    A row with a non-finite element in any leaf is removed without a host sync: its numbers become the numbers of the
    first row that is finite (its flags stay), `("collector", "mask")` is False there, and `non_finite_count` grows.
    All rows stay finite, so nothing non-finite reaches a loss or, through a zero times infinity, a gradient; and
    TorchRL's losses leave rows with a False mask out of their means. (Zeros instead of a finite row would not do: a
    standard deviation of zero has no logarithm.) If no row at all is finite, the leaves are zero where they were not,
    and every mask is False.
    """

    def __init__(self, max_size: int, *, device: torch.device | str = "auto") -> None:
        # TensorStorage wants either data or a size, and allocates from the data only.
        super().__init__(None, max_size, device=device)
        self.non_finite_count = torch.zeros((), dtype=torch.int64)
        if self.device != "auto":
            self.non_finite_count = self.non_finite_count.to(self.device)

    @torch.no_grad()
    def write(self, data: TensorDictBase) -> Int64[Tensor, " D"]:
        """Replace the content by D elements, batch dims flattened, the last one running fastest; return all indices."""
        if data.numel() != self.max_size:
            raise ValueError(
                f"the dataset holds {self.max_size} env states, the data has {data.numel()}: batch_size "
                f"{tuple(data.batch_size)}"
            )
        # The mask is kept apart: it is computed below, from the data's own and from the finite rows.
        leaves: dict[NestedKey, Tensor] = dict(data.items(include_nested=True, leaves_only=True))
        mask = leaves.pop(MASK_KEY, None)
        if not self.initialized:
            self._allocate(data.exclude(MASK_KEY))
        stored = self._stored_leaves(leaves, data.batch_dims)
        # Copied into the batch dims of the data, which spares a flattened copy of a time-major rollout.
        for key, leaf_D in stored.items():
            leaf_D.unflatten(0, data.batch_size).copy_(leaves[key])

        finite_D1 = finite_rows(stored.values())
        mask_D1: Tensor = self._storage.get(MASK_KEY)
        # A row takes part if it is finite, and if the data does not mask it.
        mask_D1.copy_(finite_D1)
        if mask is not None:
            mask_D1.logical_and_(mask.reshape(-1, 1).to(mask_D1.device))
        _replace_rows(stored.values(), keep_D1=finite_D1, donor_D1=mask_D1)
        self.non_finite_count.add_((~finite_D1).sum())
        # Bookkeeping of TorchRL's storages, which its buffers read.
        self._len = self.max_size
        self._bump_mutation_revision()
        return torch.arange(self.max_size, device=self.device)

    def state_dict(self) -> State:
        """Return the content and the counter of removed rows."""
        return super().state_dict() | {"non_finite_count": self.non_finite_count.clone()}

    def load_state_dict(self, state_dict: State) -> None:
        """Continue where `state_dict` was taken."""
        super().load_state_dict(dict(state_dict))
        # The counter follows the content, whose device is known now.
        if self.device == "auto" and self.initialized:
            self.device = self._storage.get(MASK_KEY).device
            self.non_finite_count = self.non_finite_count.to(self.device)
        self.non_finite_count.copy_(tensor(state_dict, "non_finite_count"))

    def _allocate(self, data: TensorDictBase) -> None:
        if self.device == "auto":
            self.device = next(iter(data.values(True, True))).device
            self.non_finite_count = self.non_finite_count.to(self.device)
        # Zeros, so that all rows are finite from the start.
        content: Any = data.new_zeros(torch.Size([self.max_size]), device=self.device)
        mask = torch.ones((self.max_size, 1), dtype=torch.bool, device=self.device)
        content.set(MASK_KEY, mask)
        self._storage = dims.name(content, dims.D)
        self.initialized = True

    def _stored_leaves(
        self, leaves: dict[NestedKey, Tensor], batch_dims: int
    ) -> dict[NestedKey, Tensor]:
        stored: dict[NestedKey, Tensor] = dict(
            self._storage.items(include_nested=True, leaves_only=True)
        )
        del stored[MASK_KEY]
        if stored.keys() != leaves.keys():
            missing = list(stored.keys() - leaves.keys())
            extra = list(leaves.keys() - stored.keys())
            raise ValueError(
                f"the data must have the leaves of the first write: missing {missing}, new {extra}"
            )
        for key, leaf in leaves.items():
            has_shape = stored[key].shape[1:] == leaf.shape[batch_dims:]
            if not has_shape or stored[key].dtype != leaf.dtype:
                raise ValueError(
                    f"leaf {key!r} is {leaf.dtype} {tuple(leaf.shape[batch_dims:])} per env state; the first write "
                    f"had {stored[key].dtype} {tuple(stored[key].shape[1:])}"
                )
        return stored


class DatasetWriter(Stateless, Writer):
    """Hands data to the `write` of its storage, which takes a whole dataset or rollout."""

    _storage: DatasetStorage
    refusal: ClassVar[str] = (
        "a dataset is written as a whole: use extend() with all its env states instead of add()"
    )

    def add(self, data: TensorDictBase) -> int:
        """Refuse single elements."""
        raise ValueError(self.refusal)

    def extend(self, data: TensorDictBase) -> Int64[Tensor, " N"]:
        """Write, and return the indices of the env states written."""
        if not isinstance(data, TensorDictBase):
            raise ValueError(
                f"extend() got {type(data).__name__}: expected a TensorDict, e.g. a rollout"
            )
        return self._storage.write(data)


def finite_rows(leaves_D: Iterable[Shaped[Tensor, "D *?leaf"]]) -> Bool[Tensor, "D 1"]:
    """Return bool [D, 1]: whether each element of a row is finite in all leaves."""
    finite_D1: Tensor | None = None
    for leaf_D in leaves_D:
        if leaf_D.is_floating_point():
            leaf_finite_D1 = leaf_D.isfinite().reshape(leaf_D.shape[0], -1).all(1, keepdim=True)
            if finite_D1 is None:
                finite_D1 = leaf_finite_D1
            else:
                finite_D1 = finite_D1 & leaf_finite_D1
    if finite_D1 is None:
        raise ValueError("the data has no floating-point leaf: nothing to learn from")
    return finite_D1


def _replace_rows(leaves_D: Iterable[Tensor], *, keep_D1: Tensor, donor_D1: Tensor) -> None:
    """Overwrite rows where `keep_D1` is False, in place, by the first row that `donor_D1` marks; flags stay."""
    # argmax gives the first of equal values. If none is marked it gives row 0, which nan_to_num makes finite.
    donor_1 = donor_D1.flatten().to(torch.uint8).argmax().unsqueeze(0)
    for leaf_D in leaves_D:
        # That an episode begins at a row holds for the steps that follow it in a sequence.
        if leaf_D.dtype == torch.bool:
            continue
        row = leaf_D.index_select(0, donor_1)
        if leaf_D.is_floating_point():
            row = row.nan_to_num(0.0, 0.0, 0.0)
        # Flags per row, broadcast over the dims of the leaf.
        keep = keep_D1.reshape(-1, *[1] * (leaf_D.ndim - 1))
        torch.where(keep, leaf_D, row, out=leaf_D)
