"""This module holds what transforms use of torch and TorchRL beyond their documents.

All was checked with torch 2.13.0 and TorchRL 0.14.1; `tests/transforms/test_upstream.py` names what moved.
"""

from typing import Any

from jaxtyping import Shaped
from torch import Tensor
from torchrl.envs import EnvBase, GymWrapper, TransformedEnv
from torchrl.envs.transforms import Transform


def base_of(view: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*base"] | None:
    """Return the tensor that a view shows, None for what is no view: values side by side need not be copied again."""
    return view._base


def is_in_env(transform: Transform) -> bool:
    """Whether an env holds a transform already: TorchRL calls `eval()` while it attaches one, which is no wish for it.

    The property `container` raises an error until there is one, and names the env before the transform is part of it.
    """
    if transform.__dict__.get("_container") is None:
        return False
    env = transform.container
    root = env._modules.get("_transform") if isinstance(env, TransformedEnv) else None
    return root is not None and any(module is transform for module in root.modules())


def gym_horizon(env: EnvBase) -> int | None:
    """Return the number of steps after which Gymnasium cuts an episode; None where it does not, or in another env."""
    gym_env: Any = env._env if isinstance(env, GymWrapper) else None
    return None if gym_env is None or gym_env.spec is None else gym_env.spec.max_episode_steps
