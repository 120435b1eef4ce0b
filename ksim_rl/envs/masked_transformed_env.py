"""`TransformedEnv` with masked resets, labelled specs, one seed for env and transforms, and a complete state dict."""

import copy
import functools
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from ksim_rl.device.state_tree import State
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.transforms.row_transform import seed_transforms

_BASE = "base_env."
_TRANSFORM = "transform."
_ROOT = "last_root."


class MaskedTransformedEnv(MaskedReset, TransformedEnv):
    """A `TransformedEnv` whose step, reset and rollout never make the host wait for the device.

    Trajectories equal `torchrl.envs.TransformedEnv`'s. Construct, append and insert transforms as there; a
    sequence of transforms will do for a `Compose`. Beyond it: masked resets and `reset(env_ids=...)` (see
    `MaskedReset`), the label "E" on specs and data, `set_seed` and `seed` that reach each transform, and a state dict
    that holds base env, transforms and the last root values.

    It has to be the outermost env: a stock `TransformedEnv` around it is right, but syncs.
    """

    def __init__(
        self,
        base_env: EnvBase,
        transform: Transform | Sequence[Transform] | None = None,
        *args: Any,
        **kwargs: Any,
    ) -> None:
        # TorchRL's constructor takes a single transform only.
        if isinstance(transform, Sequence):
            transform = Compose(*transform)  # pyright: ignore[reportArgumentType]
        super().__init__(base_env, transform, *args, **kwargs)
        # A base env that draws its own random actions keeps doing so.
        if type(base_env).rand_action is not EnvBase.rand_action:
            object.__setattr__(
                self, "rand_action", functools.partial(TransformedEnv.rand_action, self)
            )

    # Not TorchRL's for transformed envs: a stock `TransformedEnv` around that one refuses random actions.
    rand_action = EnvBase.rand_action

    def __copy__(self) -> "MaskedTransformedEnv":
        """Return a copy that shares nothing, where the base env can be copied."""
        return copy.deepcopy(self)

    def _make_output_spec(self) -> Composite:
        return self._labelled(super()._make_output_spec())

    def _make_input_spec(self) -> Composite:
        return self._labelled(super()._make_input_spec())  # pyright: ignore[reportArgumentType]

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed the base env and each transform; return the next seed, as TorchRL does."""
        # Transforms with draws, such as noise, start from the same seed.
        if seed is not None:
            seed_transforms(self, seed)
        return self.base_env.set_seed(seed, static_seed=static_seed)

    def state_dict(self, *args: Any, **kwargs: Any) -> OrderedDict[str, Any]:
        """Return a copy of all that a bit-exact continuation needs: base env, transforms, the last root values."""
        parts = {
            _BASE: self.base_env.state_dict(*args, **kwargs),
            _TRANSFORM: self.transform.state_dict(*args, **kwargs),
        }
        if self.last_root is not None:
            # Without the policy's leaves, which are no state of the env.
            keys = [
                *self.full_observation_spec.keys(True, True),
                *self.full_done_spec.keys(True, True),
            ]
            parts[_ROOT] = self.last_root.select(*keys, strict=False).flatten_keys("/")
        return OrderedDict(
            (f"{prefix}{key}", value.clone() if isinstance(value, Tensor) else value)
            for prefix, part in parts.items()
            for key, value in part.items()
        )

    def load_state_dict(self, state_dict: State, strict: bool = True, **kwargs: Any) -> None:
        """Load a `state_dict` of this env; a KeyError names an entry that belongs to no part of the env."""
        parts: dict[str, OrderedDict[str, Any]] = {
            p: OrderedDict() for p in (_BASE, _TRANSFORM, _ROOT)
        }
        for key, value in state_dict.items():
            # The first part of each name says whose entry it is.
            prefix = next((prefix for prefix in parts if key.startswith(prefix)), None)
            if prefix is None and not strict:
                continue
            if prefix is None:
                raise KeyError(
                    f"state_dict entry {key!r}: expected a name that starts with {' or '.join(parts)}"
                )
            parts[prefix][key.removeprefix(prefix)] = value
        self.base_env.load_state_dict(parts[_BASE], strict=strict, **kwargs)
        self.transform.load_state_dict(parts[_TRANSFORM], strict=strict, **kwargs)
        if parts[_ROOT]:
            # Clones: the saved tensors must not change with the next step.
            leaves = {key: value.clone() for key, value in parts[_ROOT].items()}
            root = TensorDict(
                leaves, batch_size=self.batch_size, device=self.device
            ).unflatten_keys("/")
            self.last_root = self._labelled(root)
