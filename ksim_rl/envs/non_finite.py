"""Watches the values of terms: a term that returns NaN or an infinity is named, with env and step."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from ksim_rl.device.quick_launch import address, as_operator, launch_of

# Beyond any place, so that a minimum over places replaces it.
_NEVER = 2**62


_quick = launch_of("ksim_rl/device/non_finite.cuh")


def _count_now(
    table_EL: Tensor, term_L: Tensor, step: Tensor, first_N: Tensor, count_N: Tensor
) -> None:
    num_rows, width = table_EL.shape
    tensors = table_EL, term_L, step, first_N, count_N
    # One thread for each number of the table.
    _quick(table_EL.device, (num_rows, width), width, num_rows, *map(address, tensors))


_count = as_operator(
    "count_non_finite", _count_now, lambda *_: None, mutates=("first_N", "count_N")
)


class NonFiniteTerms:
    """Counts non-finite numbers by term, on the device and without a sync."""

    def __init__(self, num_envs: int, step_count: Int64[Tensor, ""]) -> None:
        self._num_envs = num_envs
        self._step = step_count
        self._names = []
        self._device = step_count.device
        self._columns: dict[tuple[str, ...], Tensor] = {}
        self._is_learning = True
        self._count_N = self._first_N = torch.zeros(0, dtype=torch.int64, device=self._device)

    def watch(
        self,
        kind: str,
        table_EL: Float[Tensor, "E L"],
        names: Sequence[str],
        widths: Sequence[int] = (),
    ) -> None:
        """Look at the values of some terms of a kind, side by side; before `start` it only learns their names."""
        key = kind, *names
        if self._is_learning:
            # For each column of the table the number of its term; a term may have several columns.
            columns = [
                len(self._names) + i
                for i, n in enumerate(widths or [1] * len(names))
                for _ in range(n)
            ]
            self._columns[key] = torch.tensor(columns, dtype=torch.int32, device=self._device)
            self._names += [f"{kind} {name!r}" for name in names]
            return
        # Metrics and rewards may have other dtypes.
        if table_EL.dtype != torch.float32 or not table_EL.is_contiguous():
            # The kernel reads float32 rows that lie one behind the other.
            table_EL = table_EL.float().contiguous()
        _count(table_EL, self._columns[key], self._step, self._first_N, self._count_N)

    def start(self) -> None:
        """Count from here on: values during the construction of an env are of no state that anybody sees."""
        self._is_learning = False
        self._count_N = self._count_N.new_zeros(len(self._names))
        self._first_N = torch.full_like(self._count_N, _NEVER)

    def num_terms(self) -> Float[Tensor, ""]:
        """Return how many terms have given such a number so far, on the device."""
        return (self._count_N > 0).sum(dtype=torch.float32)

    def lines(self) -> list[str]:
        """Return a line for each of these terms; waits for the device."""
        return [
            # One number tells both: step * num_envs + env.
            f"{name} is not finite: first in env {first % self._num_envs} at its step {first // self._num_envs}, "
            f"{count} numbers so far"
            for name, count, first in zip(
                self._names, self._count_N.tolist(), self._first_N.tolist(), strict=False
            )
            if count
        ]
