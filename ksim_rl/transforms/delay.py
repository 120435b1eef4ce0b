"""Sensor latency."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from ksim_rl.transforms.columns import side_by_side, split
from ksim_rl.transforms.delay_cfg import DelayCfg
from ksim_rl.transforms.lagged_transform import LaggedTransform
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import Device, leaf_spec, set_leaf_spec


class ObservationDelay(LaggedTransform):
    """Observations as they were some env steps ago; an env that just reset sees its reset observation until then.

    All keys of one transform share the lag. A larger lag than before shows older readings again, a smaller one skips
    some. With `by_level` the range of the lag follows `follow_level_`. Delays in physics substeps are those of
    `ksim_rl.scene.actuators.DelayedActuator`.

    Args:
        in_keys: observations, of any shape and dtype; nested keys as tuples.
        out_keys: where the delayed ones go. Default: in place of the prompt ones.
        delay: how lags are drawn, in env steps.
        seed, stream: see `KeyedTransform`.

    Example:
        >>> delay = ObservationDelay(["imu"], delay=DelayCfg(min_lag=1, max_lag=3, resample_every=50))
    """

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        delay: DelayCfg,
        seed: int = 0,
        stream: str | None = None,
    ) -> None:
        in_keys = as_keys(in_keys)
        out_keys = checked_out_keys(in_keys, out_keys)
        super().__init__(delay, len(in_keys), in_keys=in_keys, out_keys=out_keys, seed=seed, stream=stream)
        self._is_joined = False

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Give the delayed observations the specs of the prompt ones."""
        specs = [leaf_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        for out_key, spec in zip(self.out_keys, specs, strict=True):
            set_leaf_spec(observation_spec, out_key, spec.clone())
        batch_dims = observation_spec.ndim
        self._size_signals(
            observation_spec.shape.numel(),
            [spec.shape[batch_dims:] for spec in specs],
            [spec.dtype for spec in specs],
            observation_spec.device,
        )
        return observation_spec

    def _size_signals(
        self, num_rows: int, shapes: list[torch.Size], dtypes: list[torch.dtype], device: Device
    ) -> None:
        """Make one ring for all observations where they are of one dtype, and one for each otherwise."""
        self._is_joined = len(shapes) > 1 and len(set(dtypes)) == 1
        if self._is_joined:
            shapes, dtypes = [torch.Size([sum(shape.numel() for shape in shapes)])], dtypes[:1]
        self._size_lags(num_rows, shapes, dtypes, device)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        values = self._read(tensordict_reset)
        mask_E = self._rows_that_reset(tensordict, tensordict_reset)
        return self._pass(tensordict_reset, values, mask_E)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        self._advance()
        return self._pass(next_tensordict, values, None)

    def _read(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Return the prompt observations, and make what the specs have not made yet."""
        values = [tensordict.get(key) for key in self.in_keys]
        if not self.num_rings:
            shapes = [value.shape[tensordict.ndim :] for value in values]
            dtypes = [value.dtype for value in values]
            self._size_signals(tensordict.numel(), shapes, dtypes, tensordict.device)
        return values

    def _pass(
        self, tensordict: TensorDictBase, values: list[Tensor], mask_E: Tensor | None
    ) -> TensorDictBase:
        """Send the values through the rings, and write what comes out; a mask says which rows begin with them."""
        found = values
        if self._is_joined:
            found = [side_by_side(values, self.num_rows)]
        found = [self._through(index, value, mask_E) for index, value in enumerate(found)]
        if self._is_joined:
            found = split(found[0], values)
        for out_key, value in zip(self.out_keys, found):  # noqa: B905 (strict takes time in every step)
            tensordict.set(out_key, value)
        return tensordict
