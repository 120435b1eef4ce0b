"""Units of actions."""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs.transforms import Transform

from ksim_rl.transforms.noise.cfg import PerDim
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.scale import check_scale
from ksim_rl.transforms.specs import (
    bounded,
    bounds,
    drop_leaf_spec,
    leaf_spec,
    set_leaf_spec,
)


class ActionScale(Transform):
    """The env receives `scale * action + offset`; the tensordict keeps the action that the policy chose.

    Args:
        in_keys_inv: the actions that the env reads.
        out_keys_inv: where the policy writes them. Default: the same keys.
        scale: a number other than 0, or one per element of the last dim. None maps [-1, 1] to the bounds of the env.
        offset: as scale; left out where `scale` is None.

    Example:
        >>> scale = ActionScale(scale=(0.25, 0.5), offset=0.1)
    """

    def __init__(
        self,
        in_keys_inv: Keys = "action",
        out_keys_inv: Keys | None = None,
        *,
        scale: PerDim | None = None,
        offset: PerDim = 0.0,
    ) -> None:
        keys = as_keys(in_keys_inv)
        super().__init__(in_keys_inv=keys, out_keys_inv=checked_out_keys(keys, out_keys_inv))
        if scale is None and offset != 0.0:
            raise ValueError(f"offset={offset!r} without scale: the bounds of the env give both")
        if scale is not None:
            check_scale("scale", scale)
            if 0 in (scale if isinstance(scale, Sequence) else [scale]):
                raise ValueError(f"scale={scale!r}: expected numbers other than 0")
        check_scale("offset", offset)
        self.scale, self.offset = scale, offset
        for index in range(len(keys)):
            self.register_buffer(f"scale_{index}", None, persistent=False)
            self.register_buffer(f"offset_{index}", None, persistent=False)

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Undo the scale in the bounds."""
        specs = [leaf_spec(action_spec, key, type(self).__name__) for key in self.in_keys_inv]
        for index, (key, spec) in enumerate(zip(self.in_keys_inv, specs, strict=True)):
            out_key = self.out_keys_inv[index]
            scale, offset = self._affine(str(key), spec)
            if self._buffers[f"scale_{index}"] is None:
                self._buffers[f"scale_{index}"], self._buffers[f"offset_{index}"] = scale, offset
            ends = [(end - offset) / scale for end in bounds(spec)]
            if key != out_key:
                drop_leaf_spec(action_spec, key)
            low, high = torch.minimum(*ends), torch.maximum(*ends)
            set_leaf_spec(action_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        return action_spec

    def _affine(self, key: str, spec: TensorSpec) -> tuple[Tensor, Tensor]:
        """Return scale and offset, one per element of the last dim, or per element of all dims from bounds."""
        if self.scale is None:
            low, high = bounds(spec)
            if not bool((torch.isfinite(low) & torch.isfinite(high) & (low < high)).all()):
                raise ValueError(f"ActionScale: {key!r} has no finite bounds: give scale")
            return (high - low) / 2, (high + low) / 2
        for name, value in (("scale", self.scale), ("offset", self.offset)):
            if isinstance(value, Sequence) and len(value) != spec.shape[-1]:
                raise ValueError(
                    f"{name} has {len(value)} numbers, but the action {key!r} has shape {tuple(spec.shape)}: "
                    "give 1 or one per element of the last dim"
                )
        scale, offset = (
            torch.tensor(value, dtype=spec.dtype, device=spec.device) for value in (self.scale, self.offset)
        )
        return scale, offset

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self._buffers["scale_0"] is None:
            # The action's bounds are in the specs only.
            assert self.container is not None and self.container.input_spec is not None
        return tensordict_reset

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        for index, (key, out_key) in enumerate(zip(self.in_keys_inv, self.out_keys_inv, strict=True)):
            scale, offset = self._buffers[f"scale_{index}"], self._buffers[f"offset_{index}"]
            if scale is None or offset is None:
                raise RuntimeError(
                    "ActionScale knows its numbers once an env holds it and has made its specs"
                )
            tensordict.set(key, torch.addcmul(offset, tensordict.get(out_key), scale))
        return tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leave a batch of samples as it is: they hold the actions that the policy chose."""
        return tensordict
