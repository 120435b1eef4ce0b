"""Explains a failed allocation by the number of envs that fit."""

import gc
import re
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import torch

from ksim_rl.device.upstream import ALLOCATION_REFUSALS

# A rollout is read in so many parts: intermediate results of a part take several times its memory.
ROLLOUT_PARTS = 4
_UNITS = {None: 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


class TooManyEnvsError(ValueError):
    """Memory does not suffice for so many envs, each of at least `per_env` bytes."""

    def __init__(self, text: str, *, per_env: int) -> None:
        super().__init__(text)
        self.per_env = per_env


@contextmanager
def memory_for(
    num_envs: int,
    device: torch.device,
    first_that_fits: Callable[[Iterable[int]], int | None] | None = None,
) -> Iterator[None]:
    """Turn an allocation that fails in this block into a TooManyEnvsError: memory of an env, and how many may fit.

    `first_that_fits` tries numbers of envs, half of `num_envs` and so on, after the memory of the block is given back.
    """
    # Measured before anything is built, to know later what this block took.
    free = free_bytes(device)
    try:
        yield
    except (RuntimeError, ValueError) as error:
        # Another error may wrap the refusal.
        asked = refused_bytes(error) or refused_bytes(error.__cause__)
        if asked is None:
            raise
        # A CPU does not tell how much memory is free for one program.
        if free is None:
            taken = 0
        else:
            taken = max(0, free - (free_bytes(device) or 0))
        # A lower bound: the block might have asked for more after this.
        per_env = max(1, (taken + asked) // num_envs)
        # Raised nearer to it, before anything was given back.
        if isinstance(error, TooManyEnvsError):
            per_env = max(per_env, error.per_env)
        most = num_envs
        fits = ""
        if free is not None:
            most = free // per_env
            fits = f" of {free / 1e9:.1f} GB that were free: at most {most} fit"
        # Before other numbers are tried, which need the same memory.
        _give_back(error, device)
        halves = [num_envs >> times for times in range(1, num_envs.bit_length())]
        if first_that_fits:
            found = first_that_fits(half for half in halves if half <= most)
        else:
            found = None
        if found is not None:
            fits += f"; num_envs={found} was tried and fits"
        raise TooManyEnvsError(
            f"num_envs={num_envs}: out of memory on {device}; one env takes at least {per_env:,} bytes{fits}. Lower "
            "num_envs, or let other programs free what they hold",
            per_env=per_env,
        ) from error


def _give_back(error: BaseException, device: torch.device) -> None:
    """Free objects that the frames of `error` and its causes hold."""
    # A list that grows in the loop: causes have causes.
    causes: list[BaseException | None] = [error]
    for cause in causes:
        if cause is not None:
            traceback.clear_frames(cause.__traceback__)
            causes += [each for each in (cause.__cause__, cause.__context__) if each not in causes]
    gc.collect()
    if device.type == "cuda" and torch.cuda.is_initialized():
        # A memory pool gives back what it does not use when the host waits.
        torch.cuda.synchronize(device)
        torch.cuda.empty_cache()


def refused_bytes(error: BaseException | None) -> int | None:
    """Return how many bytes an allocation asked for that failed, or None if `error` is no such failure."""
    for refusal in ALLOCATION_REFUSALS:
        if found := re.search(refusal, str(error)):
            parts = found.groupdict()
            return int(float(parts["size"]) * _UNITS[parts.get("unit")])
    return None


def free_bytes(device: torch.device) -> int | None:
    """Return how much of a GPU's memory is free; None of a CPU."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return None
