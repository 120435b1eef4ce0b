"""A robot of MuJoCo's C engine in the place of one of metal."""

import math
import time
from collections.abc import Collection
from pathlib import Path

import mujoco
import numpy as np

from ksim_rl.export.standalone.files import Array, measurements
from ksim_rl.export.standalone.robot_link import DescribedJoints, JointCommand, Measurement
from ksim_rl.export.standalone.runner import Runner

HELD_INERTIA = 1e6
"""kg, or kg m^2, of a root that is held: no robot moves it."""
OF_ATTITUDE = ("root_quat", "projected_gravity")
# Numbers, as arrays of a model hold them.
TO_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


class SimulatedRobot:
    """The model of `robot.xml`, which runs one period for each command.

    Its motors exert what `JointCommand` says, within their effort limits. `estimated` are the inputs of `obs.onnx` that
    its measurements have as estimates.
    """

    def __init__(self, folder: Path, estimated: Collection[str]) -> None:
        runner = Runner(folder)
        joints = DescribedJoints(runner.meta)
        model = runner.model
        self.runner = runner
        self.data = runner.data
        places = [runner.joints[name] for name in joints.names]
        self.pos = np.array([pos for pos, _ in places], int)
        self.vel = np.array([vel for _, vel in places], int)
        self.model = model
        self.actuators, self.columns = self._motors(joints)
        self.gear = model.actuator_gear[self.actuators, 0].copy()
        self.has_root = bool(model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE)
        self.hangs_below: Array | None = None
        self.fixed_root = self._fixed_root()
        self.estimates = {}
        for node in measurements(runner.meta):
            if node["input"] in estimated:
                self.estimates[node["input"]] = runner.quantity(node)

    def _motors(self, joints: DescribedJoints) -> tuple[Array, Array]:
        """Turn the first actuator of each driven joint into its motor, and the others off; return both places."""
        model = self.model
        found = {}
        for actuator in range(model.nu):
            if int(model.actuator_trntype[actuator]) not in TO_JOINTS:
                continue
            joint = model.joint(int(model.actuator_trnid[actuator, 0])).name
            if joint not in joints.names:
                continue
            model.actuator_dyntype[actuator] = mujoco.mjtDyn.mjDYN_NONE
            model.actuator_gaintype[actuator] = mujoco.mjtGain.mjGAIN_FIXED
            model.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_AFFINE
            model.actuator_ctrllimited[actuator] = 0
            model.actuator_gainprm[actuator] = 0.0
            model.actuator_biasprm[actuator] = 0.0
            if joint in found:
                continue
            found[joint] = actuator
            limit = joints.most_effort[joints.names.index(joint)]
            gear = abs(model.actuator_gear[actuator, 0])
            if np.isfinite(limit):
                model.actuator_forcelimited[actuator] = 1
                model.actuator_forcerange[actuator] = (-limit / gear, limit / gear)
        for place in np.flatnonzero(joints.driven):
            if joints.names[place] not in found:
                raise ValueError(f"robot.xml: no actuator drives the joint {joints.names[place]!r}")
        return np.array(list(found.values()), int), joints.columns(list(found))

    def _fixed_root(self) -> int | None:
        """Return the body whose attitude a policy reads, of a robot that is fixed to the world."""
        for node in measurements(self.runner.meta):
            if not self.has_root and node["quantity"] in OF_ATTITUDE:
                return int(self.model.body(node["body"]).id)
        return None

    def read(self) -> Measurement:
        """Return the sensors' readings now; a message of a simulation is never late."""
        data = self.data
        root_quat = None
        root_ang_vel = None
        if self.has_root:
            root_quat = data.qpos[3:7].copy()
            root_ang_vel = data.qvel[3:6].copy()
        elif self.fixed_root is not None:
            root_quat = data.xquat[self.fixed_root].copy()
        estimates = {}
        for name, read in self.estimates.items():
            estimates[name] = np.array(read())
        stamp = time.monotonic()
        pictures = self.runner.sight.drawn()
        return Measurement(
            stamp=stamp,
            joint_pos=data.qpos[self.pos],
            joint_vel=data.qvel[self.vel],
            joint_effort=data.qfrc_actuator[self.vel],
            root_quat=root_quat,
            root_ang_vel=root_ang_vel,
            # Of the simulation's steps: a robot at rest may measure the same to the bit.
            count=round(data.time / self.model.opt.timestep),
            estimates=estimates,
            pictures=pictures,
            # A camera of MuJoCo's has no noise: of a robot at rest its pictures are equal.
            picture_stamps=dict.fromkeys(pictures, stamp),
        )

    def write(self, command: JointCommand) -> None:
        """Run one period with a command."""
        model = self.model
        at = self.actuators
        gear = self.gear
        columns = self.columns
        stiffness = command.stiffness[columns]
        damping = command.damping[columns]
        effort = command.effort[columns] + damping * command.vel[columns]
        # An actuator's length is its gear times the position, and its force acts by the gear once more.
        model.actuator_gainprm[at, 0] = stiffness / gear
        model.actuator_biasprm[at, 0] = effort / gear
        model.actuator_biasprm[at, 1] = -stiffness / gear**2
        model.actuator_biasprm[at, 2] = -damping / gear**2
        self.data.ctrl[at] = command.pos[columns]
        if self.hangs_below is not None and (command.stiffness >= self.hangs_below).all():
            self.holds_left -= 1
            if self.holds_left < 0:
                self.hangs_below = None
                self.model.dof_armature[:6] = self.free_inertia
        if self.hangs_below is None:
            self.runner.run_physics(())
        else:
            self.runner.run_physics((self._hold_root,))

    def change_period(self, period: float) -> None:
        """Let a command last `period` seconds, in physics steps that are no longer than the model's."""
        option = self.model.opt
        self.runner.decimation = math.ceil(period / option.timestep - 1e-9)
        option.timestep = period / self.runner.decimation

    def hang(self, stiffness: Array, *, holds: int = 0, lift: float = 0.0) -> None:
        """Hold the root until all motors have a stiffness, as a robot hangs that could not stand up.

        It is held for `holds` more commands of that stiffness, and `lift` m above where it is.
        """
        if not self.has_root:
            raise ValueError("--hang: this robot has no free root")
        self.hangs_below = stiffness
        self.holds_left = holds
        self.data.qpos[2] += lift
        self.root_pos = self.data.qpos[:7].copy()
        # So that legs do not move the root within a step: they would swing as in free fall.
        self.free_inertia = self.model.dof_armature[:6].copy()
        self.model.dof_armature[:6] = HELD_INERTIA
        self.runner.refresh()

    def _hold_root(self) -> None:
        self.data.qpos[:7] = self.root_pos
        self.data.qvel[:6] = 0.0

    def close(self) -> None:
        """Do nothing: there is no connection."""
