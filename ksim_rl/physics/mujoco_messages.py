"""This module catches MuJoCo's warnings, which go to the terminal and into a file MUJOCO_LOG.TXT if left alone."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def caught_warnings() -> Iterator[list[str]]:
    """Collect the text of MuJoCo's warnings, from its engine and its bindings, instead of printing them."""
    caught: list[str] = []

    def keep(text: bytes | str) -> None:
        caught.append((text.decode(errors="replace") if isinstance(text, bytes) else text).strip())

    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(keep)
    try:
        with warnings.catch_warnings(record=True) as from_bindings:
            warnings.simplefilter("always")
            yield caught
        for warning in from_bindings:
            keep(str(warning.message))
    finally:
        mujoco.set_mju_user_warning(previous)
