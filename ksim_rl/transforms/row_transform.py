"""This module holds the base of transforms with buffers per env, which the env sizes and resets row by row."""

from collections.abc import Sequence
from typing import Any, Self

import torch
from jaxtyping import Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform

from ksim_rl.transforms.specs import Device

Keys = Sequence[NestedKey] | NestedKey


class RowTransform(Transform):
    """Base of transforms with state per env row.

    All state lives in buffers that are changed in place. Those sized by the env are made when the env first asks for
    its specs or resets, never later, so a captured step keeps its addresses.

    Args:
        in_keys, out_keys, in_keys_inv, out_keys_inv: as in `torchrl.envs.transforms.Transform`.
        row_buffers: names of the buffers that the env sizes; the first one is [E, ...].
    """

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        in_keys_inv: Keys | None = None,
        out_keys_inv: Keys | None = None,
        *,
        row_buffers: Sequence[str] = (),
    ) -> None:
        super().__init__(in_keys, out_keys, in_keys_inv, out_keys_inv)  # pyright: ignore[reportArgumentType]
        self.num_rows = 0
        self._row_buffers = list(row_buffers)
        for name in row_buffers:
            self.register_buffer(name, None)

    def _size_rows(self, num_rows: int, device: Device) -> None:
        """Take note of the number of rows; subclasses make their buffers here."""
        self.num_rows = num_rows

    def _size_buffer(self, name: str, shape: Sequence[int], dtype: torch.dtype, device: Device) -> None:
        """Make a zero buffer, unless there is one of that shape and dtype already."""
        present = self._buffers[name]
        if present is None or present.shape != torch.Size(shape) or present.dtype != dtype:
            self._buffers[name] = torch.zeros(tuple(shape), dtype=dtype, device=device)

    def _reset_rows(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> Tensor:
        """Return which rows reset, bool [E]; all of them where there is no mask."""
        if len(tensordict.keys()) == 1 and (only := tensordict.get("_reset", None)) is not None:
            return _per_row(only, self.num_rows)
        masks = [
            _per_row(mask, self.num_rows)
            for key, mask in tensordict.items(True, True)
            if key == "_reset" or key[-1] == "_reset"
        ]
        if not masks:
            return torch.ones(self.num_rows, dtype=torch.bool, device=tensordict_reset.device)
        mask_E = masks[0]
        for mask in masks[1:]:
            mask_E = mask_E | mask
        return mask_E

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse: without an env there are no steps and no resets to follow."""
        raise RuntimeError(
            f"{type(self).__name__} has state per env: use it in an env, not on a batch of samples"
        )

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
                self._buffers[name] = torch.empty_like(loaded)
        super()._load_from_state_dict(state_dict, prefix, *args)
        first = self._buffers[self._row_buffers[0]] if self._row_buffers else None
        if first is not None and not self.num_rows:
            self.num_rows = first.shape[0]


def _per_row(mask: Tensor, num_rows: int) -> Tensor:
    flat = mask.reshape(num_rows, -1)
    # Kernels read it by address.
    return flat[:, 0].contiguous() if flat.shape[1] == 1 else flat.any(-1)


def as_keys(keys: Keys) -> list[NestedKey]:
    """Return a list of keys from one key or a list of them; a tuple is one key, and ("a",) is "a"."""
    listed: list[NestedKey] = [keys] if isinstance(keys, str | tuple) else list(keys)
    return [key[0] if isinstance(key, tuple) and len(key) == 1 else key for key in listed]


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


def checked_action(
    tensordict: TensorDictBase, key: NestedKey, leaf: Sequence[int], dtype: torch.dtype
) -> Shaped[Tensor, "*leaf"]:
    """Return the action, refused before it reaches a buffer: the env sees only what comes out of that.

    Raises:
        ValueError: with both shapes and dtypes.
    """
    action = tensordict.get(key)
    expected = (*tensordict.batch_size, *leaf)
    if tuple(action.shape) != expected or action.dtype != dtype:
        raise ValueError(
            f"action {key!r} has shape {tuple(action.shape)} and dtype {action.dtype}: expected {expected} and {dtype}"
        )
    return action
