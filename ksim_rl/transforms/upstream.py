"""Undocumented interfaces of torch and TorchRL that the transforms use.

All was checked with torch 2.13.0 and 2.14.1, and TorchRL 0.14.1; `tests/transforms/test_upstream.py` names what moved.
"""

import multiprocessing
import weakref
import zlib
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor
from torchrl.envs import EnvBase, GymWrapper, TransformedEnv
from torchrl.envs.transforms import Transform


def base_of(view: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*base"] | None:
    """Return the tensor that a view shows, None if it is no view: values side by side need not be copied again."""
    return view._base


def env_of(transform: Transform) -> EnvBase | None:
    """Return the env that holds a transform, or None: the property `container` raises in a chain that no env holds."""
    # Up the chain of containers, without the property that raises.
    inside: Any = transform
    while isinstance(inside, Transform):
        reference = inside.__dict__.get("_container")
        inside = None if reference is None else reference()
    return inside


def is_in_env(transform: Transform) -> bool:
    """Whether an env holds a transform already: TorchRL calls `eval()` while it attaches one, which is no wish for it.

    A transform knows its env before it is part of it.
    """
    env = env_of(transform)
    if isinstance(env, TransformedEnv):
        root = env._modules.get("_transform")
    else:
        root = None
    return root is not None and any(module is transform for module in root.modules())


class _SetSeed:
    """The `set_seed` of a stock env, which reaches its transforms too."""

    def __init__(
        self, env: TransformedEnv, seed_transforms: Callable[[TransformedEnv, int], None]
    ) -> None:
        # A strong reference would be a cycle: an env of worker processes would not be closed with its last user.
        self.env = weakref.ref(env)
        self.seed_transforms = seed_transforms

    def __call__(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        env = self.env()
        assert env is not None
        if seed is not None:
            self.seed_transforms(env, seed)
        return TransformedEnv.set_seed(env, seed, static_seed=static_seed)

    def __reduce__(self) -> tuple[Any, ...]:
        return _SetSeed, (self.env(), self.seed_transforms)


def hear_seeds(env: EnvBase | None, seed_transforms: Callable[[TransformedEnv, int], None]) -> None:
    """Let `env.set_seed` seed the transforms of an env: `TransformedEnv.set_seed` passes seeds to the base env alone.

    The method of that one env is covered; a class that defines `set_seed` keeps it.
    """
    if isinstance(env, TransformedEnv) and type(env).set_seed is TransformedEnv.set_seed:
        # In the instance, which stock code looks at before its class.
        vars(env).setdefault("set_seed", _SetSeed(env, seed_transforms))


_SEED_AT_IMPORT = torch.initial_seed()
_generator_of_worker = torch.Generator()


def fresh_seed() -> int:
    """Return a seed for transforms without one: drawn from torch's default generator, and different in each process.

    Forked workers share the state that their parent's generator had. Spawned ones know nothing of it, and torch begins
    anywhere there: unless they call `torch.manual_seed` themselves, they draw from a generator that begins at the same
    place in each. TorchRL tells each worker its number as an argument of the process, which Python keeps in `_kwargs`;
    of others the number is in `_identity`.
    """
    process = multiprocessing.current_process()
    given = vars(process).get("_kwargs", {})
    # TorchRL's workers have different names for their number.
    told = [given[name] for name in ("worker_idx", "idx") if given.get(name) is not None]
    place = (*process._identity[:-1], *(told[:1] or process._identity[-1:]))
    # Forked workers share the generator's state, and differ by their place only.
    is_forked = not place or type(process).__name__ == "ForkProcess"
    if is_forked or torch.initial_seed() != _SEED_AT_IMPORT:
        generator = None
    else:
        generator = _generator_of_worker
    return (
        int(torch.randint(1 << 31, (), generator=generator)) << 31
        | zlib.crc32(repr(place).encode()) >> 1
    )


def gym_horizon(env: EnvBase) -> int | None:
    """Return the number of steps after which Gymnasium cuts an episode; None where it does not, or in another env."""
    if isinstance(env, GymWrapper):
        gym_env: Any = env._env
    else:
        gym_env = None
    if gym_env is None or gym_env.spec is None:
        return None
    return gym_env.spec.max_episode_steps
