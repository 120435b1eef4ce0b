"""The motor models of a scene at work."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence

from jaxtyping import Bool
from torch import Tensor

from ksim_rl.scene.actuators.actuator import Actuator, Law
from ksim_rl.scene.actuators.drive import Drive
from ksim_rl.scene.actuators.set_actuators import driven_joints
from ksim_rl.scene.state.simulation import Simulation
from ksim_rl.scene.state.world_view import WorldView


class JointDrives:
    """Turns targets into the controls of motors before each physics substep.

    Only explicit actuators have work here; without any, no hook is set and substeps stay one launch.

    Args:
        actuators: the `actuators` of each robot, by the prefix of its names.
        simulation: what is driven.
        view: whose targets are read, and whose controls are written.

    Raises:
        ValueError: naming the pattern that matches no joint, or the joint that two entries drive or that has no motor.
    """

    def __init__(
        self, actuators: Mapping[str, Sequence[Actuator]], simulation: Simulation, view: WorldView
    ) -> None:
        groups: dict[Hashable, tuple[Actuator, list[int]]] = {}
        names = view.joints().names
        for prefix, entries in actuators.items():
            ids = {name.removeprefix(prefix): i for i, name in enumerate(names) if name.startswith(prefix)}
            for actuator, driven in driven_joints(entries, list(ids)):
                if not actuator.is_explicit:
                    continue
                joints = [ids[name] for name in driven]
                groups.setdefault((prefix, actuator.law_key), (actuator, []))[1].extend(joints)
                view.targets.leave_to_law(joints, actuator.takes)
                for name, value in actuator.params.items():
                    view.actuator_params.add(name, joints, value)
        self._drives: list[tuple[Drive, Law]] = []
        for number, (actuator, joints) in enumerate(groups.values()):
            drive = Drive(f"actuators/{number}", simulation, view, sorted(joints))
            self._drives.append((drive, actuator.law(drive)))
        if self._drives:
            self._apply()
            simulation.before_substep.append(self._apply)

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw the lags of the rows of `mask_E`, bool [E]."""
        for drive, _ in self._drives:
            drive.reset(mask_E)

    def _apply(self) -> None:
        for drive, law in self._drives:
            drive.write(law(drive.state(), drive.target()))
