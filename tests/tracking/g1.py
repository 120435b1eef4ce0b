"""Unitree G1 for tests, or a skip where its model is not on this machine."""

from functools import cache

import mujoco
import pytest

from ksim_rl.scene.robots.unitree_g1 import UnitreeG1


@cache
def _model() -> mujoco.MjModel | str:
    try:
        return UnitreeG1().spec().compile()
    except ValueError as error:
        return str(error)


def g1_model() -> mujoco.MjModel:
    """The robot alone; a new copy would do no harm, but takes half a second."""
    model = _model()
    if isinstance(model, str):
        assert "menagerie" in model
        pytest.skip(model)
    return model
