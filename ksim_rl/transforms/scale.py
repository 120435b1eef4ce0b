"""Units of observations."""

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite
from torchrl.envs.transforms import Transform

from ksim_rl import checks
from ksim_rl.transforms.noise.cfg import PerDim
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import (
    bounded,
    bounds,
    floating_spec,
    multiply_bounds,
    set_leaf_spec,
)


class ObservationScale(Transform):
    """Multiply observations by a fixed factor.

    Args:
        in_keys: floating-point observations; nested keys as tuples.
        out_keys: where the scaled ones go. Default: in place.
        scale: a number or one per element of the last dim, for all keys; or a mapping with one of these per key.

    Example:
        >>> scale = ObservationScale(["joint_vel"], scale=0.05)
    """

    def __init__(
        self, in_keys: Keys, out_keys: Keys | None = None, *, scale: PerDim | Mapping[NestedKey, PerDim]
    ) -> None:
        in_keys = as_keys(in_keys)
        super().__init__(in_keys, checked_out_keys(in_keys, out_keys))
        if isinstance(scale, Mapping) and set(scale) != set(self.in_keys):
            raise ValueError(
                f"scale has the keys {list(scale)}, but in_keys={self.in_keys}: give one per key"
            )
        for index, key in enumerate(self.in_keys):
            factor = scale[key] if isinstance(scale, Mapping) else scale
            check_scale(f"scale of {key!r}", factor)
            self.register_buffer(
                f"factor_{index}", torch.tensor(factor, dtype=torch.float32), persistent=False
            )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Scale the bounds."""
        specs = [floating_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        for index, (key, out_key, spec) in enumerate(zip(self.in_keys, self.out_keys, specs, strict=True)):
            factor: torch.Tensor = getattr(self, f"factor_{index}").to(spec.device)
            if factor.ndim and (len(spec.shape) == 0 or factor.shape[0] != spec.shape[-1]):
                raise ValueError(
                    f"scale of {key!r} has {factor.shape[0]} numbers, but the observation has shape "
                    f"{tuple(spec.shape)}: give 1 or one per element of the last dim"
                )
            low, high = bounds(spec)
            low, high = multiply_bounds((low, high), (factor.expand(low.shape), factor.expand(low.shape)))
            set_leaf_spec(observation_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        return observation_spec

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for index, (key, out_key) in enumerate(zip(self.in_keys, self.out_keys, strict=True)):
            value = next_tensordict.get(key)
            next_tensordict.set(out_key, (value * getattr(self, f"factor_{index}")).to(value.dtype))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do the same to a batch of samples."""
        return self._call(tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)


def check_scale(field: str, scale: PerDim) -> None:
    """Refuse what is neither a finite number nor a tuple of them.

    Raises:
        ValueError: naming the field and the value.
    """
    for index, factor in enumerate(scale if isinstance(scale, tuple | list) else [scale]):
        checks.check_in_range(f"{field}[{index}]" if isinstance(scale, tuple | list) else field, factor)
