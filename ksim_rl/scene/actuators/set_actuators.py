"""This module edits a robot's `MjSpec` so that its joints have their actuators."""

from collections.abc import Sequence

import mujoco

from ksim_rl.scene.actuators.actuator import Actuator
from ksim_rl.scene.names import match_names

_OF_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def set_actuators(spec: mujoco.MjSpec, actuators: Sequence[Actuator]) -> None:
    """Give each matching joint one actuator, named as its joint, in the order of `actuators`.

    Actuators of the model that drive the same joints are replaced, and their sensors read the new ones; the model's
    other actuators stay, in front.

    Raises:
        ValueError: naming the pattern that matches no joint, or the joint that two entries drive.
    """
    joints = {joint.name: joint for joint in spec.joints if joint.type in _SCALAR}
    driven = driven_joints(actuators, list(joints))
    new_names = {name for _, names in driven for name in names}
    replaced: dict[str, str] = {}
    for old in list(spec.actuators):
        if old.trntype in _OF_JOINTS and old.target in new_names:
            replaced[old.name] = old.target
            spec.delete(old)
    for sensor in spec.sensors:
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR and sensor.objname in replaced:
            sensor.objname = replaced[sensor.objname]
    for actuator, names in driven:
        for name in names:
            new = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.configure(new, joints[name])


def driven_joints(
    actuators: Sequence[Actuator], joint_names: Sequence[str]
) -> list[tuple[Actuator, list[str]]]:
    """Return which of the joints each entry drives, in the order of `joint_names`.

    Raises:
        ValueError: naming the pattern that matches no joint, or the joint that two entries drive.
    """
    driven: list[tuple[Actuator, list[str]]] = []
    entry_of: dict[str, int] = {}
    for number, actuator in enumerate(actuators):
        patterns = (actuator.driven,) if isinstance(actuator.driven, str) else actuator.driven
        names = [joint_names[i] for i in sorted(match_names("joint", tuple(patterns), joint_names))]
        for name in names:
            if name in entry_of:
                raise ValueError(
                    f"joint {name!r} is driven by actuators[{entry_of[name]}] and actuators[{number}]: expected one"
                )
            entry_of[name] = number
        driven.append((actuator, names))
    return driven
