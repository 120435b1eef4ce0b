"""Arrays that C computes only for sensors which need them, computed here one world after the other."""

import copy
from collections.abc import Callable, Iterable
from functools import cached_property

import mujoco
import mujoco.batch
import numpy as np

from ksim_rl.physics.views import FORCES_OF_BODIES, SUBTREE_VELOCITIES

_SENSORS = mujoco.mjtSensor
# The sensors for which C computes them by itself.
_FOR_SENSORS = {
    FORCES_OF_BODIES: (
        *(_SENSORS.mjSENS_ACCELEROMETER, _SENSORS.mjSENS_FORCE, _SENSORS.mjSENS_TORQUE),
        *(_SENSORS.mjSENS_FRAMELINACC, _SENSORS.mjSENS_FRAMEANGACC),
    ),
    SUBTREE_VELOCITIES: (_SENSORS.mjSENS_SUBTREELINVEL, _SENSORS.mjSENS_SUBTREEANGMOM),
}
_FUNCTIONS = {
    FORCES_OF_BODIES: mujoco.mj_rnePostConstraint,
    SUBTREE_VELOCITIES: mujoco.mj_subtreeVel,
}


def left_out(mj_model: mujoco.MjModel) -> frozenset[str]:
    """Return the names of the arrays that no sensor of the model makes C compute."""
    # Without sensors C computes neither group.
    if mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
        return FORCES_OF_BODIES | SUBTREE_VELOCITIES
    missing: set[str] = set()
    for names, kinds in _FOR_SENSORS.items():
        if not np.isin(mj_model.sensor_type, kinds).any():
            missing |= names
    return frozenset(missing)


class ByWorld:
    """Some of those arrays, [E, body, ...], filled from the data of the batch's simulations."""

    def __init__(self, batch: mujoco.batch.Batch) -> None:
        self._batch = batch
        self._arrays: dict[frozenset[str], dict[str, np.ndarray]] = {}

    # One model and one data serve all worlds in turn.
    @cached_property
    def _mj_model(self) -> mujoco.MjModel:
        return copy.copy(self._batch.model)

    @cached_property
    def _mj_data(self) -> mujoco.MjData:
        return mujoco.MjData(self._mj_model)

    def array(self, name: str) -> np.ndarray:
        """Return the array of that name, zeros at first, which `fill` fills from then on."""
        # C's function fills all arrays of a group in one call.
        if name in FORCES_OF_BODIES:
            together = FORCES_OF_BODIES
        else:
            together = SUBTREE_VELOCITIES
        if together not in self._arrays:
            self._arrays[together] = {one: self._zeros(one) for one in together}
        return self._arrays[together][name]

    def has(self, together: frozenset[str]) -> bool:
        """Whether anything reads arrays of that group."""
        return together in self._arrays

    def fill(self, together: frozenset[str], row_ids: Iterable[int]) -> None:
        """Compute the arrays of a group, if anything reads them, from the stages that the last call computed."""
        if not self.has(together):
            return
        compute: Callable[[mujoco.MjModel, mujoco.MjData], None] = _FUNCTIONS[together]
        for row in row_ids:
            # Masses and gravity differ between worlds.
            self._batch.get_model(row, self._mj_model)
            self._batch.get_data(row, self._mj_data)
            compute(self._mj_model, self._mj_data)
            for name, array in self._arrays[together].items():
                array[row] = getattr(self._mj_data, name)

    def _zeros(self, name: str) -> np.ndarray:
        return np.zeros((self._batch.nsim, *getattr(self._mj_data, name).shape))
