"""This module explains a failed allocation by the number of envs that fit."""

import gc
import re
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import torch

from ksim_rl.device.upstream import ALLOCATION_REFUSALS

_UNITS = {None: 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


@contextmanager
def memory_for(
    num_envs: int, device: torch.device, work: Callable[[int], object] | None = None
) -> Iterator[None]:
    """Turn an allocation that fails in this block into a ValueError: what one of the envs takes, and how many fit.

    `work` does the same with another number of envs and returns what holds their memory: half as many are tried, and
    so on, until it works and leaves a tenth of the memory free.
    """
    free, fewer = _free_bytes(device), num_envs
    try:
        yield
    except (RuntimeError, ValueError) as error:
        asked = refused_bytes(error) or refused_bytes(error.__cause__)
        if asked is None:
            raise
        taken = 0 if free is None else max(0, free - (_free_bytes(device) or 0))
        per_env = max(1, (taken + asked) // num_envs)
        fits = (
            "" if free is None else f" of {free / 1e9:.1f} GB that were free: at most {free // per_env} fit"
        )
        traceback.clear_frames(error.__traceback__)  # they hold what was built
        while work is not None and (fewer := fewer // 2):
            gc.collect()
            if torch.cuda.is_initialized():
                # A memory pool gives back what it does not use when the host waits.
                torch.cuda.synchronize(device)
                torch.cuda.empty_cache()
            with suppress(RuntimeError, ValueError):  # too many as well, or they do not divide the data
                held = work(fewer), (_free_bytes(device) or 0) >= (free or 0) / 10
                if held[1]:
                    fits += f"; num_envs={fewer} was tried and fits"
                    break
            held = None
        raise ValueError(
            f"num_envs={num_envs}: out of memory on {device}; one env takes at least {per_env:,} bytes{fits}. Lower "
            "num_envs, or let other programs free what they hold"
        ) from error


def refused_bytes(error: BaseException | None) -> int | None:
    """Return how many bytes an allocation asked for that failed, or None if `error` is no such failure."""
    for refusal in ALLOCATION_REFUSALS:
        if found := re.search(refusal, str(error)):
            parts = found.groupdict()
            return int(float(parts["size"]) * _UNITS[parts.get("unit")])
    return None


def _free_bytes(device: torch.device) -> int | None:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else None
