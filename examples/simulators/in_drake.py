"""Runs an exported policy in Drake, a second simulator, beside MuJoCo's C engine, from the same starts.

    pip install drake onnxruntime mujoco
    python examples/simulators/in_drake.py runs/arm_reach/2026-11-29_22-00-00/export --episodes 10

For robots on a fixed base that touch nothing, such as arms. Drake's plant has the masses, inertias, joints, armatures
and dampings of the folder's `robot.xml` as MuJoCo compiles it, and Drake moves it; the folder's own `runner.py`
computes observations, the policy, the laws of motors, and rewards. What Drake does not get, such as springs, dry
friction and floating bases, is refused by name; contacts are left out.
"""

import argparse
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

FINER = 10
"""Steps of Drake in one of MuJoCo: efforts are held for a step, which stiff servos need to be short."""
JOINTS = {
    int(mujoco.mjtJoint.mjJNT_HINGE): RevoluteJoint,
    int(mujoco.mjtJoint.mjJNT_SLIDE): PrismaticJoint,
}


def drake_runner(folder: Path):
    """Return the folder's own runner, whose physics is Drake's."""
    base = _module(folder / "runner.py").Runner

    class DrakeRunner(base):
        """An exported policy whose robot is moved by Drake."""

        def __init__(self, folder: Path) -> None:
            super().__init__(folder)
            self.drake = Plant(self.model)

        def run_physics(self, laws) -> None:
            """Run one env step: MuJoCo's actuators give efforts, and Drake moves the joints."""
            self.drake.place(self.data.qpos, self.data.qvel)
            for _ in range(self.decimation):
                for law in laws:
                    law()
                for _ in range(FINER):
                    # Efforts of the present state, with their limits.
                    mujoco.mj_forward(self.model, self.data)
                    self.drake.step(self.data.qfrc_actuator)
                    self.data.qpos[:], self.data.qvel[:] = self.drake.state()
            self.refresh()
            self.steps += 1

    return DrakeRunner(folder)


class Plant:
    """Drake's plant of a compiled model, with MuJoCo's joints in MuJoCo's order."""

    def __init__(self, model: mujoco.MjModel) -> None:
        _check(model)
        self._step = model.opt.timestep / FINER
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=self._step)
        bodies = [plant.world_body()]
        actuators = []
        for body in range(1, model.nbody):
            made = plant.AddRigidBody(f"{body}", _inertia(model, body))
            parent = bodies[model.body_parentid[body]]
            pose = RigidTransform(_turned(model.body_quat[body]), model.body_pos[body])
            if model.body_jntnum[body]:
                actuators.append(_joined(plant, model, body, (parent, made), pose))
            else:
                plant.WeldFrames(parent.body_frame(), made.body_frame(), pose)
            bodies.append(made)
        plant.mutable_gravity_field().set_gravity_vector(model.opt.gravity)
        if model.ngravcomp:
            plant.set_gravity_enabled(bodies[1].model_instance(), False)
        plant.Finalize()
        self._plant = plant
        self._diagram = builder.Build()
        self._simulator = Simulator(self._diagram)
        self._context = plant.GetMyMutableContextFromRoot(self._simulator.get_mutable_context())
        self._zero = np.array(model.qpos0)
        # Of Drake's vectors, the places of MuJoCo's joints.
        self._input = np.array([actuator.input_start() for actuator in actuators])
        self._pos = np.array([actuator.joint().position_start() for actuator in actuators])
        self._vel = np.array([actuator.joint().velocity_start() for actuator in actuators])

    def place(self, pos, vel) -> None:
        """Put the joints somewhere."""
        state = np.zeros(self._plant.num_multibody_states())
        state[self._pos] = pos - self._zero
        state[self._plant.num_positions() + self._vel] = vel
        self._plant.SetPositionsAndVelocities(self._context, state)

    def step(self, effort) -> None:
        """Move by one step under these efforts of the joints."""
        ordered = np.zeros(len(effort))
        ordered[self._input] = effort
        self._plant.get_actuation_input_port().FixValue(self._context, ordered)
        time = self._simulator.get_context().get_time()
        self._simulator.AdvanceTo(time + self._step)

    def state(self):
        """Return positions and velocities of the joints."""
        pos = self._plant.GetPositions(self._context)[self._pos]
        vel = self._plant.GetVelocities(self._context)[self._vel]
        return pos + self._zero, vel


def _check(model: mujoco.MjModel) -> None:
    """Refuse what this example does not hand to Drake."""
    masses = model.body_mass > 0.0
    compensated = model.body_gravcomp[masses & (model.body_weldid > 0)]
    refused = {
        "joints other than hinges and slides": not set(model.jnt_type) <= set(JOINTS),
        "two joints in one body": bool((model.body_jntnum > 1).any()),
        "springs": bool(model.jnt_stiffness.any()),
        "dry friction": bool(model.dof_frictionloss.any()),
        "equality constraints": bool(model.neq),
        "tendons": bool(model.ntendon),
        "gravity compensation of some bodies only": len(set(compensated)) > 1
        or not set(compensated) <= {0.0, 1.0},
    }
    for what, has in refused.items():
        if has:
            raise ValueError(f"robot.xml has {what}: this example is of plain arms")


def _inertia(model: mujoco.MjModel, body: int) -> SpatialInertia:
    """Return mass and inertia in the frame of the body, from MuJoCo's principal axes."""
    mass = float(model.body_mass[body])
    # Such as a floor.
    if mass == 0.0:
        return SpatialInertia.Zero()
    principal = RotationalInertia(*model.body_inertia[body])
    turned = principal.ReExpress(_turned(model.body_iquat[body]))
    return SpatialInertia.MakeFromCentralInertia(mass, model.body_ipos[body], turned)


def _joined(
    plant: MultibodyPlant,
    model: mujoco.MjModel,
    body: int,
    pair: tuple[RigidBody, RigidBody],
    pose: RigidTransform,
):
    """Add the joint of a body with its damping and range, and a motor of its armature."""
    parent, made = pair
    joint = int(model.body_jntadr[body])
    dof = int(model.jnt_dofadr[joint])
    at = RigidTransform(model.jnt_pos[joint])
    kind = JOINTS[int(model.jnt_type[joint])]
    low, high = (-np.inf, np.inf)
    if model.jnt_limited[joint]:
        # Drake counts from the pose of the file, MuJoCo from its reference.
        low, high = model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]]
    own = kind(
        name=model.joint(joint).name,
        frame_on_parent=plant.AddFrame(_fixed(parent, pose @ at, f"{body} on parent")),
        frame_on_child=plant.AddFrame(_fixed(made, at, f"{body} on child")),
        axis=model.jnt_axis[joint],
        pos_lower_limit=low,
        pos_upper_limit=high,
        damping=float(model.dof_damping.reshape(model.nv, -1)[dof, 0]),
    )
    added = plant.AddJoint(own)
    actuator = plant.AddJointActuator(f"{body}", added)
    actuator.set_default_rotor_inertia(float(model.dof_armature[dof]))
    actuator.set_default_gear_ratio(1.0)
    return actuator


def _fixed(body: RigidBody, pose: RigidTransform, name: str):
    return FixedOffsetFrame(name, body.body_frame(), pose)


def _turned(quat) -> RotationMatrix:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return RotationMatrix(matrix.reshape(3, 3))


def _module(path: Path) -> ModuleType:
    """Import the folder's own runner; it is code: run folders of your own only."""
    spec = importlib.util.spec_from_file_location("runner", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["runner"] = module
    spec.loader.exec_module(module)
    return module


def main() -> int:
    """Run recorded episodes again, and print both returns."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="that `ksim-rl export` wrote")
    parser.add_argument("--episodes", type=int, default=10)
    options = parser.parse_args()
    in_drake = drake_runner(options.folder)
    in_mujoco = _module(options.folder / "runner.py").Runner(options.folder)
    with np.load(options.folder / "episodes.npz") as file:
        record = dict(file)
    returns = []
    for number in range(min(options.episodes, len(record["start/qpos"]))):
        pair = [runner.episode(record, number)["return"] for runner in (in_mujoco, in_drake)]
        print(f"episode {number}: MuJoCo {pair[0]:.3f}, Drake {pair[1]:.3f}")
        returns.append(pair)
    mujoco_mean, drake_mean = np.mean(returns, axis=0)
    print(f"mean return: MuJoCo {mujoco_mean:.3f}, Drake {drake_mean:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
