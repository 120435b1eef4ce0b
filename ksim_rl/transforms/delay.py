"""Observations and actions arrive some env steps late by the transforms of this module."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from ksim_rl.transforms.columns import side_by_side, split
from ksim_rl.transforms.lagged_transform import DelayCfg, LaggedTransform
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_action, checked_out_keys
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


class ActionDelay(LaggedTransform):
    """The env receives the action of some env steps ago; the tensordict keeps the one that the policy chose.

    Until the first action of an episode arrives, the env receives `initial`. With `by_level` the range of the lag
    follows `follow_level_`. A delay of the targets in physics substeps is `ksim_rl.scene.actuators.DelayedActuator`.

    Args:
        in_keys_inv: the actions that the env reads.
        out_keys_inv: where the policy writes them. Default: the same keys.
        delay: how lags are drawn, in env steps.
        initial: what every element of the action is before the first one arrives.
        seed, stream: see `KeyedTransform`.

    Example:
        >>> delay = ActionDelay(delay=DelayCfg(min_lag=0, max_lag=2))
    """

    def __init__(
        self,
        in_keys_inv: Keys = "action",
        out_keys_inv: Keys | None = None,
        *,
        delay: DelayCfg,
        initial: float = 0.0,
        seed: int = 0,
        stream: str | None = None,
    ) -> None:
        keys = as_keys(in_keys_inv)
        out_keys = checked_out_keys(keys, out_keys_inv)
        super().__init__(delay, len(keys), in_keys_inv=keys, out_keys_inv=out_keys, seed=seed, stream=stream)
        self.initial = initial

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Move the specs to where the policy writes."""
        specs = [leaf_spec(action_spec, key, type(self).__name__) for key in self.in_keys_inv]
        for key, out_key, spec in zip(self.in_keys_inv, self.out_keys_inv, specs, strict=True):
            if key != out_key:
                del action_spec[key]
                set_leaf_spec(action_spec, out_key, spec.clone())
        batch_dims = action_spec.ndim
        self._size_lags(
            action_spec.shape.numel(),
            [spec.shape[batch_dims:] for spec in specs],
            [spec.dtype for spec in specs],
            action_spec.device,
        )
        return action_spec

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if not self._sized:
            # The action's shape is in the specs only, and they size the buffers.
            assert self.container is not None and self.container.input_spec is not None
        mask_E = self._rows_that_reset(tensordict, tensordict_reset)
        for index in range(len(self.in_keys_inv)):
            ring_EM: torch.Tensor = getattr(self, f"ring_{index}")
            self._through(index, torch.full_like(ring_EM[:, 0], self.initial), mask_E)
        return tensordict_reset

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self._sized:
            raise RuntimeError("ActionDelay has state per env: use it in an env, not on a batch of samples")
        actions = [self._checked(index, tensordict, key) for index, key in enumerate(self.out_keys_inv)]
        self._advance()
        for index, (key, action) in enumerate(zip(self.in_keys_inv, actions, strict=True)):
            tensordict.set(key, self._through(index, action, None))
        return tensordict

    def _checked(self, index: int, tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
        """Return the action, refused here since the env sees it only after the buffer."""
        ring_EM: torch.Tensor = getattr(self, f"ring_{index}")
        return checked_action(tensordict, key, ring_EM.shape[2:], ring_EM.dtype)
