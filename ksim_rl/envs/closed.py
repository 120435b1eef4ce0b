"""Stands in for the parts of a closed env."""

from typing import NoReturn


class Closed:
    """Replaces each part of a closed env, and says so in an error."""

    def __getattr__(self, name: str) -> NoReturn:
        raise RuntimeError(
            "the env is closed, and the memory of its worlds is free: make another one"
        )
