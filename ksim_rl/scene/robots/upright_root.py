"""Readies a stranger's spec for walking tasks: names for all, a root that is free, and z up."""

import math

import mujoco
import numpy as np

from ksim_rl.scene.robots.edit import compiled_bodies, write_inertia

FREE = mujoco.mjtJoint.mjJNT_FREE
Quaternion = tuple[float, float, float, float]
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
LEAST_UP = math.cos(math.radians(30.0))
"""A root that tilts more in its stance has another axis than z upwards."""


def name_all(spec: mujoco.MjSpec) -> list[str]:
    """Name the bodies and joints that have no name by their kind and place, and return these names."""
    # A free joint needs no name.
    joints = [joint for joint in spec.joints if joint.type != FREE]
    given = []
    # Without the world, which has its name.
    for kind, elements in (("body", list(spec.bodies)[1:]), ("joint", joints)):
        taken = {element.name for element in elements}
        for number, element in enumerate(elements, 1):
            if element.name:
                continue
            # The file may use such a name elsewhere.
            name = f"{kind}{number}"
            while name in taken:
                name += "_"
            element.name = name
            given.append(name)
    return given


def free_root(spec: mujoco.MjSpec, root: str) -> None:
    """Let a body that is fixed to the world move freely."""
    spec.body(root).add_freejoint()


def fixed_root(spec: mujoco.MjSpec) -> str | None:
    """Return the only body that stands in the world, if it has no joint there, else None."""
    # With several bodies in the world it is not told which one is the robot.
    standing = list(spec.worldbody.bodies)
    if len(standing) != 1 or list(standing[0].joints):
        return None
    return standing[0].name


def turn_of_root(quat: np.ndarray) -> Quaternion:
    """Return how the root's frame is to be turned so that its z axis points up in a pose where it has `quat`."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    # The lower right entry: the z component of the body's z axis.
    if matrix[8] >= LEAST_UP:
        return UPRIGHT
    inverse = np.zeros(4)
    mujoco.mju_negQuat(inverse, quat)
    # Rounded, since it is written into code.
    w, x, y, z = (round(float(value), 6) for value in inverse)
    return w, x, y, z


def turn_root(spec: mujoco.MjSpec, root: str, quat: Quaternion) -> None:
    """Turn the frame of the root body by a quaternion (w, x, y, z), and leave all that it carries in place.

    A body that stood upright at orientation `p` then does so at `p * quat`.
    """
    body = spec.body(root)
    # Inertia first: it is read from the body as it still is.
    _turn_inertia(spec, body, quat)
    kinds = (body.frames, body.bodies, body.geoms, body.sites, body.cameras, body.lights)
    # Elements in frames move along with these.
    loose = [element for kind in kinds for element in kind if element.frame is None]
    # The contents turn back by as much as the body turns.
    back = np.zeros(4)
    mujoco.mju_negQuat(back, np.array(quat))
    frame = body.add_frame(quat=back)
    for element in loose:
        element.set_frame(frame)


def _turn_inertia(spec: mujoco.MjSpec, body: mujoco.MjsBody, quat: Quaternion) -> None:
    """Write an explicit inertia down in the axes of the turned frame; one of the geoms follows these by itself."""
    # Without it the compiler infers inertia from the geoms, which have been turned.
    if not body.explicitinertial:
        return
    back = np.zeros(4)
    mujoco.mju_negQuat(back, np.array(quat))
    mj_model = compiled_bodies(spec)
    number = mj_model.body(body.name).id
    ipos = np.zeros(3)
    iquat = np.zeros(4)
    # Both by the inverse turn, from the old axes into the new ones.
    mujoco.mju_rotVecQuat(ipos, mj_model.body_ipos[number], back)
    mujoco.mju_mulQuat(iquat, back, mj_model.body_iquat[number])
    write_inertia(body, mj_model, number, ipos=ipos, iquat=iquat)
