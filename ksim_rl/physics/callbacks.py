"""This module tells callbacks of MuJoCo Warp that a program sets, at any time, from our own."""

from collections.abc import Callable

import mujoco_warp as mjw


class Callbacks:
    """The callbacks of a world's model, of which those that are set by now are our own.

    Ours only launch kernels; those that a program sets later may do anything.
    """

    def __init__(self, warp_model: mjw.Model) -> None:
        self._callback = warp_model.callback
        self._own = dict(vars(self._callback))
        self._filters: Callable[[mjw.Model, mjw.Data], None] | None = None

    def of_program(self) -> tuple[str, ...]:
        """Return the names of the callbacks that a program has set and not taken away."""
        present = vars(self._callback).items()
        return tuple(name for name, callback in present if callback and callback is not self._own[name])

    def keep_our_filter(self) -> None:
        """Let our filter of contacts run before one that a program has set in its place.

        Ours is where contacts of height fields come from: without it robots fall through the ground.
        """
        own, present = self._own["contactfilter"], self._callback.contactfilter
        if own is None or present is own or present is self._filters:
            return
        if present is None:
            self._callback.contactfilter = own
            return

        def both(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
            own(warp_model, warp_data_E)
            present(warp_model, warp_data_E)

        self._filters = both
        self._callback.contactfilter = both
