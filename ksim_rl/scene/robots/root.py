"""This module readies a stranger's spec for walking tasks: names for all, a root that is free, and z up."""

from collections.abc import Iterable

import mujoco
import numpy as np

from ksim_rl.scene.robots.edit import Vector, copy_inertia

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
MOST_TILT = np.cos(np.pi / 6)
"""Cosine of the tilt, 30 degrees, up to which a root's z axis counts as upwards."""


def name_all(spec: mujoco.MjSpec) -> list[str]:
    """Give bodies and joints without a name one of their own, and return these."""
    given = []
    for kind, elements in (("body", list(spec.bodies)[1:]), ("joint", list(spec.joints))):
        taken = {element.name for element in elements}
        for number, element in enumerate(elements, 1):
            if element.name or getattr_type(element) == mujoco.mjtJoint.mjJNT_FREE:
                continue
            element.name = _free_name(f"{kind}{number}", taken)
            given.append(element.name)
    return given
