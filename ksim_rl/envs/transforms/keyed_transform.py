"""What transforms with state share: keyed draws, rows of a reset, buffers sized by the env, a copy that is a copy."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform

from ksim_rl import random

Keys = Sequence[NestedKey] | NestedKey


class KeyedTransform(Transform):
    """Base of transforms with per-env state; its draws are a function of (seed, stream, env row, counter).

    Draws in a step are keyed by `step_count`, which counts env steps; draws at a reset by `reset_count_E`, which counts
    each row's own resets. So a reset of one row never changes another row's numbers.

    All state lives in buffers that are changed in place. Those sized by the env are made when the env first asks for
    its specs or resets, never later, so a captured step keeps its addresses.

    Args:
        in_keys, out_keys, in_keys_inv, out_keys_inv: as in `torchrl.envs.transforms.Transform`.
        seed: until `seed_` or the env's `set_seed` gives another one.
        stream: name of the stream of draws. Default: class name and keys, so two transforms of one env differ unless
            they are of one class and have the same keys.
    """

    purposes: ClassVar[tuple[str, ...]] = ()
    """What the class draws, each from a stream of its own."""

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        in_keys_inv: Keys | None = None,
        out_keys_inv: Keys | None = None,
        *,
        seed: int = 0,
        stream: str | None = None,
    ) -> None:
        super().__init__(in_keys, out_keys, in_keys_inv, out_keys_inv)  # pyright: ignore[reportArgumentType]
        if stream is None:
            stream = f"{type(self).__name__}{self.in_keys}{self.out_keys}{self.in_keys_inv}{self.out_keys_inv}"
        self.stream = stream
        self._stream_ids = {purpose: random.stream_id(f"{stream}/{purpose}") for purpose in self.purposes}
        self.num_rows = 0
        self.register_buffer("seed_value", torch.tensor(seed, dtype=torch.int64))
        self.register_buffer("step_count", torch.zeros((), dtype=torch.int64))
        self.register_buffer("reset_count_E", None)

    seed_value: Tensor
    step_count: Tensor
    reset_count_E: Tensor

    def seed_(self, seed: int) -> Self:
        """Set the seed and start the counters anew, in place."""
        self.seed_value.fill_(seed)
        self.step_count.zero_()
        if self.reset_count_E is not None:
            self.reset_count_E.zero_()
        return self

    def _step_keys(self, purpose: str) -> random.RowKeys:
        return random.row_keys(self.seed_value, self._stream_ids[purpose], self.step_count, self.num_rows)

    def _reset_keys(self, purpose: str) -> random.RowKeys:
        return random.row_keys(self.seed_value, self._stream_ids[purpose], self.reset_count_E, self.num_rows)

    def _size_rows(self, num_rows: int, device: torch.device | None) -> None:
        """Make the counters of `num_rows` rows; subclasses make their own buffers beside them."""
        self.num_rows = num_rows
        self._size_buffer("reset_count_E", (num_rows,), torch.int64, device)

    def _size_buffer(
        self, name: str, shape: Sequence[int], dtype: torch.dtype, device: torch.device | None
    ) -> None:
        """Make a zero buffer, unless there is one of that shape and dtype already."""
        present = self._buffers[name]
        if present is None or present.shape != torch.Size(shape) or present.dtype != dtype:
            self._buffers[name] = torch.zeros(tuple(shape), dtype=dtype, device=device or self.step_count.device)

    def _reset_rows(self, tensordict: TensorDictBase) -> Tensor:
        """Return which rows reset, bool [E], and count it in `reset_count_E`."""
        masks = [
            mask.reshape(self.num_rows, -1).any(-1)
            for key, mask in tensordict.items(True, True)
            if key == "_reset" or key[-1] == "_reset"
        ]
        if masks:
            mask_E = masks[0]
            for mask in masks[1:]:
                mask_E = mask_E | mask
        else:
            mask_E = torch.ones(self.num_rows, dtype=torch.bool, device=self.step_count.device)
        self.reset_count_E.add_(mask_E)
        return mask_E

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse: without an env there are no steps and no resets to follow."""
        raise RuntimeError(f"{type(self).__name__} has state per env: use it in an env, not on a batch of samples")

    def clone(self) -> Self:
        """Copy with buffers of its own: TorchRL rebuilds parts of an env from clones and may run them."""
        copy = super().clone()
        copy._buffers = {name: None if b is None else b.clone() for name, b in self._buffers.items()}
        return copy

    def _in_env(self) -> bool:
        """Whether an env holds this transform already (TorchRL calls `eval()` while it attaches one)."""
        if self.__dict__.get("_container") is None:
            return False
        env = self.container
        root = env._modules.get("_transform") if isinstance(env, TransformedEnv) else None
        return root is not None and any(module is self for module in root.modules())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # Buffers that the env has not sized yet take the size of the loaded ones.
        for name, present in self._buffers.items():
            loaded = state_dict.get(prefix + name)
            if present is None and loaded is not None:
                self._buffers[name] = torch.empty_like(loaded, device=self.step_count.device)
        super()._load_from_state_dict(state_dict, prefix, *args)
        if self.reset_count_E is not None:
            self.num_rows = self.reset_count_E.shape[0]


def as_keys(keys: Keys) -> list[NestedKey]:
    """Return a list of keys from one key or a sequence of them, as TorchRL's constructors do."""
    return [keys] if isinstance(keys, str | tuple) else list(keys)


def checked_out_keys(in_keys: list[NestedKey], out_keys: Keys | None) -> list[NestedKey]:
    """Return the out keys, by default the in keys.

    Raises:
        ValueError: if their numbers differ, or an out key repeats.
    """
    out = list(in_keys) if out_keys is None else as_keys(out_keys)
    if len(out) != len(in_keys):
        raise ValueError(f"out_keys={out} has {len(out)} keys for the {len(in_keys)} of in_keys={in_keys}")
    if len(set(out)) != len(out):
        raise ValueError(f"out_keys={out} repeats a key: each needs its own place")
    return out
