"""Tells the callbacks that a program sets in MuJoCo Warp apart from our own."""

from collections.abc import Callable

import mujoco_warp as mjw


class Callbacks:
    """The callbacks of a world's model; those that are set by now are our own.

    Ours only launch kernels; those that a program sets later may do anything.
    """

    def __init__(self, warp_model: mjw.Model) -> None:
        self._callback = warp_model.callback
        # A copy of the names and functions that are set now.
        self._own = dict(vars(self._callback))
        self._ours_first: dict[str, Callable[..., None]] = {}

    def of_program(self) -> tuple[str, ...]:
        """Return the names of the callbacks that a program has set and not taken away."""
        present = vars(self._callback).items()
        return tuple(
            name for name, callback in present if callback and callback is not self._own[name]
        )

    def keep_ours(self) -> None:
        """Let our callbacks run before those that a program has set in their place.

        Contacts of height fields come from our filter of contacts: without it robots fall through the ground.
        """
        for name, own in self._own.items():
            present = vars(self._callback)[name]
            # Nothing changed since the last substep: ours alone, or ours before the program's.
            if own is None or present is own or present is self._ours_first.get(name):
                continue
            if present is not None:
                self._ours_first[name] = _in_turn(own, present)
            # A program that took a callback away gets ours back.
            setattr(self._callback, name, own if present is None else self._ours_first[name])


def _in_turn(first: Callable[..., None], second: Callable[..., None]) -> Callable[..., None]:
    def both(*args: mjw.Model | mjw.Data) -> None:
        first(*args)
        second(*args)

    return both
