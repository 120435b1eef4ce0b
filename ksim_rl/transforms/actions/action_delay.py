"""Command latency."""

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite

from ksim_rl.transforms.actions.action_keys import checked_action
from ksim_rl.transforms.delay_cfg import DelayCfg
from ksim_rl.transforms.lagged_transform import LaggedTransform
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import leaf_spec, set_leaf_spec


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
