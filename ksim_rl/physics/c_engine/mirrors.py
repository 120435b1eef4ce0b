"""Float32 torch tensors beside the float64 arrays of the C engine, and the copies between them."""

import warnings
from collections.abc import Iterable

import mujoco.batch
import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

# Rotation matrices, which MuJoCo stores as nine numbers in a row.
MATRICES = frozenset(("xmat", "ximat", "geom_xmat", "site_xmat", "cam_xmat", "cam_mat0"))
# Flags, which a batch keeps among its numbers.
FLAGS = frozenset(("eq_active",))


class Mirror:
    """A tensor [E, ...] that shows an array of the C engine: float32 for its float64, int32 for its integers."""

    def __init__(self, name: str, array: np.ndarray) -> None:
        shape = _shape(name, array)
        with warnings.catch_warnings():
            # Outputs are read-only, and are only read.
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            self._present = torch.from_numpy(array).view(shape)
        self.tensor = torch.zeros(shape, dtype=_dtype(name, array))
        # The tensor as the array and it were last equal, up to rounding.
        self._seen = self.tensor.clone()
        self.pull()

    def pull(self, row_ids_N: Int[Tensor, " N"] | None = None) -> None:
        """Show the array's present numbers, in all rows or in some, int64 [N]."""
        if row_ids_N is None:
            self.tensor.copy_(self._present)
            self._seen.copy_(self.tensor)
        else:
            self.tensor[row_ids_N] = self._present[row_ids_N].to(self.tensor.dtype)
            self._seen[row_ids_N] = self.tensor[row_ids_N]

    def push(self) -> None:
        """Write the tensor's numbers into the array, all of which are float32 from then on."""
        self._present.copy_(self.tensor)
        self._seen.copy_(self.tensor)

    def push_changes(self) -> bool:
        """Write the numbers that have changed since the last copy; whether there are any.

        The others keep the digits that rounding to float32 takes away.
        """
        changed = self.tensor.ne(self._seen)
        if self.tensor.is_floating_point():
            # NaN differs from itself.
            changed &= ~(self.tensor.isnan() & self._seen.isnan())
        if not bool(changed.any()):
            return False
        self._present[changed] = self.tensor[changed].to(self._present.dtype)
        self._seen.copy_(self.tensor)
        return True


def bound(batch: mujoco.batch.Batch, names: Iterable[str]) -> dict[str, Mirror]:
    """Return mirrors of data arrays, without those that are empty in this model."""
    found: dict[str, Mirror] = {}
    for name in names:
        array = batch.bind(name)
        if array.size:
            found[name] = Mirror(name, array)
    return found


def _shape(name: str, array: np.ndarray) -> tuple[int, ...]:
    if name in MATRICES:
        return (*array.shape[:-1], 3, 3)
    return array.shape


def _dtype(name: str, array: np.ndarray) -> torch.dtype:
    if name in FLAGS:
        return torch.bool
    if np.issubdtype(array.dtype, np.floating):
        return torch.float32
    return torch.int32
