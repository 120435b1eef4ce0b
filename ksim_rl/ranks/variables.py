"""Reads the numbers that torchrun sets in the environment of each rank."""

import os


def number(name: str, *, least: int = 0) -> int:
    """Return a variable's whole number; a ValueError names the variable unless it has one of at least `least`."""
    text = os.environ[name].strip()
    if not text.isdecimal() or int(text) < least:
        raise ValueError(
            f"{name}={text}: expected a whole number of at least {least}, which torchrun sets; unset it where "
            "this is one process"
        )
    return int(text)


def world_size() -> int:
    """Return how many ranks were started together: 1 without torchrun."""
    if not os.environ.get("WORLD_SIZE"):
        return 1
    return number("WORLD_SIZE", least=1)
