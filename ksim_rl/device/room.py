"""Refuses configs and sizes that no memory holds, before anything is allocated."""

import os

import torch

from ksim_rl.checked import Checked, parts

# Of a number in memory: float32 nearly everywhere.
_NUMBER_BYTES = 4


def check_room(cfg: Checked, *, num_envs: int, device: torch.device, path: str = "") -> None:
    """Refuse a config if one part alone takes more memory than the whole device has.

    `Checked.least_numbers` gives the sizes, so that nothing has to be allocated to know them. What passes may
    still be too much: a failed allocation tells. The ValueError names the fields, which stand at `path`.
    """
    for where, part in parts(cfg, path):
        for names, numbers in part.least_numbers(num_envs).items():
            given = ", ".join(
                f"{where}.{name}={getattr(part, name)!r}".removeprefix(".") for name in names
            )
            check_bytes(given, _NUMBER_BYTES * numbers, num_envs=num_envs, device=device)


def check_bytes(
    given: str,
    needed: float,
    *,
    device: torch.device,
    num_envs: int | None = None,
    fix: str = "lower it",
) -> None:
    """Refuse sizes that take more memory than the whole device has; `given` has the fields and values that do.

    Sizes that depend on the number of envs are given with it.
    """
    total = total_bytes(device)
    if needed > total:
        envs = ""
        if num_envs is not None:
            envs = f" with num_envs={num_envs}"
        raise ValueError(
            f"{given}: takes at least {needed / 1e9:,.0f} GB of memory{envs}, and {device} has {total / 1e9:.1f} GB: "
            f"{fix}"
        )


def total_bytes(device: torch.device) -> int:
    """Return how much memory a GPU has, or the machine for its CPU."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[1]
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
