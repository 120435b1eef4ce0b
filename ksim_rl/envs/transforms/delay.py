"""Sensor latency."""

from tensordict import TensorDictBase
from torchrl.data import Composite

from ksim_rl.envs.transforms.delay_cfg import DelayCfg
from ksim_rl.envs.transforms.lagged_transform import LaggedTransform
from ksim_rl.envs.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.envs.transforms.specs import leaf_spec, set_leaf_spec


class ObservationDelay(LaggedTransform):
    """Observations as they were some env steps ago; an env that just reset sees its reset observation until then.

    All keys of one transform share the lag. A larger lag than before shows older readings again, a smaller one skips
    some. With `by_level` the range of the lag follows `follow_level_`. Delays in physics substeps are those of
    `ksim_rl.envs.actuators.DelayedActuator`.

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

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Give the delayed observations the specs of the prompt ones."""
        specs = [leaf_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        for out_key, spec in zip(self.out_keys, specs, strict=True):
            set_leaf_spec(observation_spec, out_key, spec.clone())
        batch_dims = observation_spec.ndim
        self._size_lags(
            observation_spec.shape.numel(),
            [spec.shape[batch_dims:] for spec in specs],
            [spec.dtype for spec in specs],
            observation_spec.device,
        )
        return observation_spec

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        batch_size = tensordict_reset.batch_size
        values = [tensordict_reset.get(key) for key in self.in_keys]
        if not self._sized:
            shapes = [value.shape[len(batch_size) :] for value in values]
            dtypes = [value.dtype for value in values]
            self._size_lags(batch_size.numel(), shapes, dtypes, tensordict_reset.device)
        mask_E = self._reset_rows(tensordict, tensordict_reset)
        self._restart(mask_E)
        for index, (out_key, value) in enumerate(zip(self.out_keys, values, strict=True)):
            value_E = value.reshape(self.num_rows, *value.shape[len(batch_size) :])
            tensordict_reset.set(out_key, self._begin(index, value_E, mask_E).reshape(value.shape))
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._advance()
        for index, (key, out_key) in enumerate(zip(self.in_keys, self.out_keys, strict=True)):
            value = next_tensordict.get(key)
            value_E = value.reshape(self.num_rows, *value.shape[next_tensordict.ndim :])
            next_tensordict.set(out_key, self._push(index, value_E).reshape(value.shape))
        return next_tensordict
