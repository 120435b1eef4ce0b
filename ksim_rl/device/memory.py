"""This module explains a failed allocation by the number of envs that fit."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from ksim_rl.device.upstream import ALLOCATION_REFUSALS

_UNITS = {None: 1, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


@contextmanager
def memory_for(num_envs: int, device: torch.device) -> Iterator[None]:
    """Turn an allocation that fails in this block into a ValueError: what one of the envs takes, and how many fit."""
    free = _free_bytes(device)
    try:
        yield
    except RuntimeError as error:
        asked = refused_bytes(error)
        if asked is None:
            raise
        left = _free_bytes(device)
        taken = 0 if free is None or left is None else max(0, free - left)
        per_env = max(1, (taken + asked) // num_envs)
        free_text = "" if free is None else f" of the {free / 1e9:.1f} GB that were free"
        fits = "" if free is None else f"{free_text}, enough for {free // per_env}"
        raise ValueError(
            f"num_envs={num_envs}: out of memory on {device}; one env takes at least {per_env:,} bytes{fits}. Lower "
            "num_envs, or let other programs free what they hold"
        ) from error


def refused_bytes(error: RuntimeError) -> int | None:
    """Return how many bytes an allocation asked for that failed, or None if `error` is no such failure."""
    for refusal in ALLOCATION_REFUSALS:
        if found := re.search(refusal, str(error)):
            parts = found.groupdict()
            return int(float(parts["size"]) * _UNITS[parts.get("unit")])
    return None


def _free_bytes(device: torch.device) -> int | None:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else None
