"""`TransformedEnv` with masked resets, labelled specs, one seed for env and transforms, and a complete state dict."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from ksim_rl import dims
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.transforms.row_transform import KeyedTransform

_BASE, _TRANSFORM, _ROOT = "base_env.", "transform.", "last_root."


class MaskedTransformedEnv(MaskedReset, TransformedEnv):
    """A `TransformedEnv` whose step, reset and rollout never make the host wait for the device.

    Trajectories equal those of `torchrl.envs.TransformedEnv`. Construct, append and insert transforms as there; a
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
        if isinstance(transform, Sequence):
            transform = Compose(*transform)  # pyright: ignore[reportArgumentType]
        super().__init__(base_env, transform, *args, **kwargs)

    def _make_output_spec(self) -> Composite:
        return self._labelled_spec(super()._make_output_spec())

    def _make_input_spec(self) -> Composite:
        return self._labelled_spec(super()._make_input_spec())  # pyright: ignore[reportArgumentType]

    def _labelled_spec(self, spec: Composite) -> Composite:
        if spec.ndim == len(self.batch_size) and spec.ndim:
            spec.names = self.dim_names
        return spec

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed the base env and each transform; return the next seed, as TorchRL does."""
        if seed is not None:
            self.seed_transforms_(seed)
        return self.base_env.set_seed(seed, static_seed=static_seed)

    def seed_transforms_(self, seed: int) -> None:
        """Seed the transforms alone, as `set_seed` does: for a base env that has its seed already."""
        for transform in keyed_transforms(self):
            transform.seed_(seed)

    def state_dict(self, *args: Any, **kwargs: Any) -> OrderedDict[str, Any]:
        """Return a copy of all that a bit-exact continuation needs: base env, transforms, the last root values."""
        state: OrderedDict[str, Any] = OrderedDict()
        for key, value in self.base_env.state_dict(*args, **kwargs).items():
            state[_BASE + key] = _copy(value)
        for key, value in self.transform.state_dict(*args, **kwargs).items():
            state[_TRANSFORM + key] = _copy(value)
        if self.last_root is not None:
            keys = [*self.full_observation_spec.keys(True, True), *self.full_done_spec.keys(True, True)]
            root = self.last_root.select(*keys, strict=False)
            for key in root.keys(True, True):
                state[_ROOT + ("/".join(key) if isinstance(key, tuple) else key)] = _copy(root.get(key))
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:
        """Load what `state_dict` returned.

        Raises:
            KeyError: if an entry belongs to no part of the env.
        """
        parts: dict[str, OrderedDict[str, Any]] = {p: OrderedDict() for p in (_BASE, _TRANSFORM, _ROOT)}
        for key, value in state_dict.items():
            prefix = next((prefix for prefix in parts if key.startswith(prefix)), None)
            if prefix is None:
                raise KeyError(
                    f"state_dict entry {key!r}: expected a name that starts with {' or '.join(parts)}"
                )
            parts[prefix][key.removeprefix(prefix)] = value
        self.base_env.load_state_dict(parts[_BASE], **kwargs)
        self.transform.load_state_dict(parts[_TRANSFORM], **kwargs)
        if parts[_ROOT]:
            root = TensorDict({}, batch_size=self.batch_size, device=self.device)
            for key, value in parts[_ROOT].items():
                root.set(tuple(key.split("/")) if "/" in key else key, value.to(self.device).clone())
            self.last_root = dims.name(root, *self.dim_names) if self.batch_size else root  # pyright: ignore


def _copy(value: Any) -> Any:
    return value.clone() if isinstance(value, Tensor) else value


def keyed_transforms(env: TransformedEnv) -> Iterator[KeyedTransform]:
    """Yield each transform with draws or counters of its own, also those of a `TransformedEnv` further inside."""
    inner: Any = env
    while isinstance(inner, TransformedEnv):
        for module in inner.transform.modules():
            if isinstance(module, KeyedTransform):
                yield module
        inner = inner.base_env
