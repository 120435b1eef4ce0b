"""The last values of a signal, one per physics substep."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from ksim_rl.scene.actuators.drive import Drive


class SubstepRing:
    """The last `depth` values [E, L] of a signal, the newest first; before an episode's first value lies that value."""

    def __init__(self, drive: Drive, name: str, depth: int, width: int) -> None:
        # Of a row that resets, what lies there is never read again, so there is no need to clear it.
        self._ring_EKL = drive.buffer(f"{name}_EKL", depth, width, keep=True)
        self._started_E = drive.buffer(f"{name}_started_E", dtype=torch.bool)

    def push(self, value_EL: Float[Tensor, "E L"]) -> None:
        """Add the value of this substep."""
        newest_E1L = value_EL[:, None]
        shifted_EKL = torch.cat((newest_E1L, self._ring_EKL[:, :-1]), dim=1)
        self._ring_EKL.copy_(torch.where(self._started_E[:, None, None], shifted_EKL, newest_E1L))
        self._started_E.fill_(True)

    def at(self, lag: int) -> Float[Tensor, "E L"]:
        """Return the value of `lag` substeps ago, [E, L]."""
        return self._ring_EKL[:, lag]

    def at_rows(self, lag_E: Int64[Tensor, " E"]) -> Float[Tensor, "E L"]:
        """Return the value of each row's own number of substeps ago (int64 [E]), [E, L]."""
        index_E1L = lag_E[:, None, None].expand(-1, 1, self._ring_EKL.shape[2])
        return self._ring_EKL.gather(1, index_E1L)[:, 0]
