"""This module finds steps that make the host wait, and tensors that steps leave behind."""

import gc

from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.testing.replays import Replays
from ksim_rl.testing.sync_count import count_syncs

_GROWTH_STEPS = 10


def check_syncs(env: EnvBase, num_steps: int) -> None:
    """A step with its masked reset never waits for the device."""
    replays = Replays(env, num_steps)
    root = replays.start()
    # The first step may compile and fill caches.
    _, root = replays.step(root, 0)
    with count_syncs() as syncs:
        for index in range(1, num_steps):
            _, root = replays.step(root, index)
    if syncs.total:
        raise AssertionError(
            f"{num_steps - 1} steps make the host wait {syncs.total} times. Use masks and `torch.where` instead of "
            f"these, and `ksim_rl.envs.MaskedTransformedEnv` instead of TorchRL's `TransformedEnv`:\n{syncs.report()}"
        )


def check_memory(env: EnvBase, num_steps: int) -> None:
    """Steps leave no tensors behind."""
    replays = Replays(env, num_steps)
    root = replays.start()
    counts = []
    for _ in range(2):
        for index in range(_GROWTH_STEPS):
            _, root = replays.step(root, index % num_steps)
        gc.collect()
        counts.append(_live_tensors())
    grown = counts[1] - counts[0]
    if grown >= _GROWTH_STEPS:
        raise AssertionError(
            f"{_GROWTH_STEPS} steps leave {grown} tensors behind. Something keeps what each step makes: look for lists "
            "and dicts that are appended to in `_step`, in a term or in a transform"
        )


def _live_tensors() -> int:
    # `type`, because `isinstance` would ask proxies that warn when they are looked at.
    return sum(issubclass(type(thing), Tensor) for thing in gc.get_objects())
