"""Edits a spec so that joints have their actuators, and runs the laws of these in the worlds."""

from collections.abc import Hashable, Mapping, Sequence

import mujoco
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.scene.actuators.actuator import Actuator, Drive, Law
from ksim_rl.scene.actuators.motors import DelayedActuator
from ksim_rl.scene.keyframes import compile_keyframes, let_new_servos_hold
from ksim_rl.scene.names import SCALAR_JOINTS, TO_JOINTS, as_patterns, match_names
from ksim_rl.scene.state.simulation import Simulation
from ksim_rl.scene.state.world_view import WorldView


def set_actuators(spec: mujoco.MjSpec, actuators: Sequence[Actuator]) -> None:
    """Give each matching joint one actuator, named as its joint, in the order of `actuators`.

    Actuators of the model that drive the same joints are replaced, and their sensors read the new ones; the model's
    other actuators stay, in front. Keyframes keep the controls and activations of these, and new servos hold the poses.
    """
    # Balls and free joints have no single position to drive.
    joints = {joint.name: joint for joint in spec.joints if joint.type in SCALAR_JOINTS}
    driven = driven_joints(actuators, list(joints))
    new_names = {name for _, names in driven for name in names}
    replaced: dict[str, str] = {}
    # Only keyframes that hold controls or activations have something to lose.
    says_controls = bool(driven) and any(len(key.ctrl) or len(key.act) for key in spec.keys)
    # Only a compiled spec knows which numbers of a keyframe belong to an actuator that goes.
    if says_controls:
        compile_keyframes(spec)
    # A list, since the loop deletes from the spec.
    for old in list(spec.actuators):
        if old.trntype in TO_JOINTS and old.target in new_names:
            # Remembered, so that sensors can follow to the new actuators.
            replaced[old.name] = old.target
            spec.delete(old)
    for sensor in spec.sensors:
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR and sensor.objname in replaced:
            sensor.objname = replaced[sensor.objname]
    for actuator, names in driven:
        for name in names:
            # Named as its joint: terms and sensors find it by the joint's name.
            new = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.configure(new, joints[name])
    # After all actuators are in: the spec is compiled again for the poses.
    if says_controls:
        let_new_servos_hold(spec, new_names)


def driven_joints(
    actuators: Sequence[Actuator], joint_names: Sequence[str]
) -> list[tuple[Actuator, list[str]]]:
    """Return which of the joints each entry drives, in the order of `joint_names`; a ValueError if two drive one."""
    driven: list[tuple[Actuator, list[str]]] = []
    entry_of: dict[str, int] = {}
    # In the order of the joints, whatever the order of the patterns.
    for number, actuator in enumerate(actuators):
        found = match_names("joint", as_patterns(actuator.driven), joint_names)
        names = [joint_names[i] for i in sorted(found)]
        for name in names:
            if name in entry_of:
                raise ValueError(
                    f"joint {name!r} is driven by actuators[{entry_of[name]}] and actuators[{number}]: expected one"
                )
            entry_of[name] = number
        driven.append((actuator, names))
    return driven


class JointDrives:
    """Turns targets into the controls of motors before each physics substep.

    Only explicit actuators have work here; without any, no hook is set and substeps stay one launch. `actuators` are
    the entries of each robot, by the prefix of its names.
    """

    def __init__(
        self, actuators: Mapping[str, Sequence[Actuator]], simulation: Simulation, view: WorldView
    ) -> None:
        _check_lag_groups([entry for entries in actuators.values() for entry in entries])
        groups: dict[Hashable, tuple[Actuator, list[int]]] = {}
        names = view.joints().names
        for prefix, entries in actuators.items():
            # Entries name joints without the robot's prefix.
            ids = {
                name.removeprefix(prefix): i
                for i, name in enumerate(names)
                if name.startswith(prefix)
            }
            for actuator, driven in driven_joints(entries, list(ids)):
                if not actuator.is_explicit:
                    continue
                joints = [ids[name] for name in driven]
                # Entries with equal laws share one call per substep, for each robot.
                groups.setdefault((prefix, actuator.law_key), (actuator, []))[1].extend(joints)
                # Before the law is made: controls of these joints are the law's from here on.
                view.targets.leave_to_law(joints, actuator.takes)
                for name, value in actuator.params.items():
                    view.actuator_params.add(name, joints, value)
        self._simulation = simulation
        self._drives: list[tuple[Drive, Actuator, Law]] = []
        # Numbered in the order of the entries: buffers and draws are named by it.
        for number, (actuator, joints) in enumerate(groups.values()):
            drive = Drive(f"actuators/{number}", simulation, view, sorted(joints))
            self._drives.append((drive, actuator, actuator.law(drive)))
        if self._drives:
            self.apply()
            simulation.before_substep.append(self.apply)

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw the lags of the rows of `mask_E`."""
        for drive, _, _ in self._drives:
            drive.reset(mask_E)

    def apply(self) -> None:
        """Write the controls of the present state and targets, as before each substep."""
        for drive, actuator, law in self._drives:
            # In the law's scope, so that its errors name it and its draws are its own.
            with self._simulation.scope(drive.name, part=actuator):
                control_EN = law(drive.state(), drive.target())
            drive.write(control_EN)


def _check_lag_groups(entries: Sequence[Actuator]) -> None:
    """Refuse delayed actuators of one group whose lags have other bounds, by a ValueError."""
    bounds: dict[str, tuple[int, int]] = {}
    for entry in entries:
        if not isinstance(entry, DelayedActuator) or not entry.lag_group:
            continue
        own = (entry.min_lag, entry.max_lag)
        first = bounds.setdefault(entry.lag_group, own)
        if own != first:
            raise ValueError(
                f"lag_group={entry.lag_group!r}: lags from {first[0]} to {first[1]} and from {own[0]} to {own[1]}; "
                "entries of one group have one lag: give them the same bounds"
            )
