"""Runs an exported policy in Drake, a second simulator, beside MuJoCo's C engine, from the same starts.

    pip install drake onnxruntime mujoco
    python examples/simulators/in_drake.py runs/arm_reach/2026-11-29_22-00-00/export --episodes 10

For arms on a fixed base that touch nothing, and for robots with a free root on flat ground. Drake's plant has the
masses, inertias, joints, armatures and dampings of the folder's `robot.xml` as MuJoCo compiles it, and Drake moves it;
the folder's own `runner.py` computes observations, the policy, the laws of motors, and rewards. Contacts of a free
robot with the ground are Drake's own, with the friction of the model; its parts do not touch each other. What
observations and rewards read of contacts is what MuJoCo finds in Drake's state. What Drake does not get, such as
springs, dry friction and uneven ground, is refused by name.
"""

import argparse
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
from pydrake.geometry import (
    AddContactMaterial,
    Box,
    Capsule,
    CollisionFilterDeclaration,
    Cylinder,
    Ellipsoid,
    GeometrySet,
    HalfSpace,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    MultibodyPlant,
)
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
ROUGH = 10.0
"""Friction of planes in Drake, which mixes the frictions of a pair; a part's is chosen so that the mix is MuJoCo's."""
STIFFNESS = 5e4
"""N/m, of a contact: a foot with a quarter of 15 kg on it sinks in by less than a millimetre."""
DISSIPATION = 5.0
"""s/m, of Hunt and Crossley's law."""
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

        def _begin(self, record, number) -> None:
            super()._begin(record, number)
            # Masses and frictions of this episode are in the model by now.
            self.drake = Plant(self.model)

        def run_physics(self, laws) -> None:
            """Run one env step: MuJoCo's actuators give efforts, and Drake moves the joints."""
            self.drake.place(self.data.qpos, self.data.qvel)
            for substep in range(self.decimation):
                for law in laws:
                    law()
                for _ in range(FINER):
                    # Efforts of the present state, with their limits.
                    mujoco.mj_forward(self.model, self.data)
                    self.drake.step(self.data.qfrc_actuator)
                    self.data.qpos[:], self.data.qvel[:] = self.drake.state()
                self._feel(self.model.opt.timestep, starts=not substep, every=True)
            for keep in self.of_contacts:
                keep()
            self.refresh()
            self.steps += 1
            self._feel(self.step_dt, starts=True, every=False)

        def _feel(self, dt: float, *, starts: bool, every: bool) -> None:
            """Let contact sensors read what MuJoCo finds in the state."""
            for tracker in self.contacts.values():
                if tracker.every is every:
                    tracker.update(self.data, dt, starts=starts)

    return DrakeRunner(folder)


class Plant:
    """Drake's plant of a compiled model, with MuJoCo's joints in MuJoCo's order."""

    def __init__(self, model: mujoco.MjModel) -> None:
        _check(model)
        self._step = model.opt.timestep / FINER
        builder = DiagramBuilder()
        plant, scene = AddMultibodyPlantSceneGraph(builder, time_step=self._step)
        bodies = [plant.world_body()]
        actuators = []
        for body in range(1, model.nbody):
            made = plant.AddRigidBody(f"{body}", _inertia(model, body))
            parent = bodies[model.body_parentid[body]]
            pose = RigidTransform(_turned(model.body_quat[body]), model.body_pos[body])
            if _is_free(model, body):
                # Drake lets a body float that nothing holds.
                pass
            elif model.body_jntnum[body]:
                actuators.append(_joined(plant, model, body, (parent, made), pose))
            else:
                plant.WeldFrames(parent.body_frame(), made.body_frame(), pose)
            bodies.append(made)
        plant.mutable_gravity_field().set_gravity_vector(model.opt.gravity)
        if model.ngravcomp:
            plant.set_gravity_enabled(bodies[1].model_instance(), False)
        self._root = bodies[1] if _is_free(model, 1) else None
        if self._root is not None:
            _add_contacts(plant, scene, model, bodies)
        plant.Finalize()
        self._plant = plant
        self._diagram = builder.Build()
        self._simulator = Simulator(self._diagram)
        self._context = plant.GetMyMutableContextFromRoot(self._simulator.get_mutable_context())
        # Of MuJoCo's vectors, the places behind a free root.
        self._behind_pos = 7 if self._root is not None else 0
        self._behind_vel = 6 if self._root is not None else 0
        self._zero = np.array(model.qpos0[self._behind_pos :])
        # Of Drake's vectors, the places of MuJoCo's joints.
        self._input = np.array([actuator.input_start() for actuator in actuators])
        self._pos = np.array([actuator.joint().position_start() for actuator in actuators])
        self._vel = np.array([actuator.joint().velocity_start() for actuator in actuators])

    def place(self, pos, vel) -> None:
        """Put the joints somewhere, and a free root, in MuJoCo's vectors."""
        ours_pos = self._plant.GetPositions(self._context)
        ours_vel = self._plant.GetVelocities(self._context)
        ours_pos[self._pos] = pos[self._behind_pos :] - self._zero
        ours_vel[self._vel] = vel[self._behind_vel :]
        if self._root is not None:
            at_pos, at_vel = self._of_root()
            ours_pos[at_pos] = np.concatenate((pos[3:7], pos[:3]))
            # Turning is in the root's axes there, and in the world's here.
            turning = _turned(pos[3:7]).matrix() @ vel[3:6]
            ours_vel[at_vel] = np.concatenate((turning, vel[:3]))
        self._plant.SetPositions(self._context, ours_pos)
        self._plant.SetVelocities(self._context, ours_vel)

    def _of_root(self):
        """Return the places of quaternion and position, and of turning and velocity, in Drake's vectors."""
        pos = self._root.floating_positions_start()
        vel = self._root.floating_velocities_start_in_v()
        return slice(pos, pos + 7), slice(vel, vel + 6)

    def step(self, effort) -> None:
        """Move by one step under these efforts of the joints, in MuJoCo's vector."""
        driven = effort[self._behind_vel :]
        ordered = np.zeros(len(driven))
        ordered[self._input] = driven
        self._plant.get_actuation_input_port().FixValue(self._context, ordered)
        time = self._simulator.get_context().get_time()
        self._simulator.AdvanceTo(time + self._step)

    def state(self):
        """Return positions and velocities of the joints, and of a free root, as MuJoCo's vectors."""
        ours_pos = self._plant.GetPositions(self._context)
        ours_vel = self._plant.GetVelocities(self._context)
        pos = ours_pos[self._pos] + self._zero
        vel = ours_vel[self._vel]
        if self._root is None:
            return pos, vel
        at_pos, at_vel = self._of_root()
        quat, place = np.split(ours_pos[at_pos], [4])
        turning, speed = np.split(ours_vel[at_vel], [3])
        turning = _turned(quat).matrix().T @ turning
        return np.concatenate((place, quat, pos)), np.concatenate((speed, turning, vel))


def _check(model: mujoco.MjModel) -> None:
    """Refuse what this example does not hand to Drake."""
    masses = model.body_mass > 0.0
    free = int(_is_free(model, 1))
    compensated = model.body_gravcomp[masses & (model.body_weldid > 0)]
    refused = {
        "joints other than hinges, slides and a free root": not set(model.jnt_type[free:])
        <= set(JOINTS),
        "uneven ground": bool(free and model.nhfield),
        "damping of a free root": bool(model.dof_damping.reshape(model.nv, -1)[: 6 * free].any()),
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
            raise ValueError(f"robot.xml has {what}: this example is of plain arms and legs")


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    joint = int(model.body_jntadr[body])
    return joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE


def _add_contacts(plant: MultibodyPlant, scene, model: mujoco.MjModel, bodies) -> None:
    """Let the parts of a robot touch the planes of the world, with the friction of the model."""
    planes = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE]
    robot = GeometrySet()
    for plane in planes:
        pose = _pose_in_root(model, plane)
        plant.RegisterCollisionGeometry(
            plant.world_body(), pose, HalfSpace(), f"plane {plane}", _material(ROUGH)
        )
    for geom in range(model.ngeom):
        touched = [plane for plane in planes if geom != plane and _touch(model, geom, plane)]
        body = int(model.geom_bodyid[geom])
        if not touched or not model.body_weldid[body]:
            continue
        friction = {_friction(model, geom, plane) for plane in touched}
        if len(friction) > 1:
            raise ValueError(f"robot.xml: geom {geom} slides differently on two planes")
        if model.geom_condim[geom] > 3:
            raise ValueError(
                f"robot.xml: geom {geom} resists turning and rolling (condim={model.geom_condim[geom]}), which Drake's "
                "points of contact do not"
            )
        # Drake takes 2 a b / (a + b) of both.
        target = friction.pop()
        own = target * ROUGH / (2.0 * ROUGH - target)
        pose = RigidTransform(_turned(model.geom_quat[geom]), model.geom_pos[geom])
        added = plant.RegisterCollisionGeometry(
            bodies[body], pose, _shape(model, geom), f"geom {geom}", _material(own)
        )
        robot.Add(added)
    apart = CollisionFilterDeclaration().ExcludeWithin(robot)
    scene.collision_filter_manager().Apply(apart)


def _touch(model: mujoco.MjModel, one: int, other: int) -> bool:
    ours = int(model.geom_contype[one] & model.geom_conaffinity[other])
    return bool(ours or model.geom_contype[other] & model.geom_conaffinity[one])


def _friction(model: mujoco.MjModel, one: int, other: int) -> float:
    """Return MuJoCo's sliding friction of a pair: from the geom of higher priority, or the larger one."""
    first, second = (float(model.geom_friction[geom, 0]) for geom in (one, other))
    ahead = int(model.geom_priority[one] - model.geom_priority[other])
    if ahead:
        return first if ahead > 0 else second
    return max(first, second)


def _pose_in_root(model: mujoco.MjModel, geom: int) -> RigidTransform:
    """Return the pose of a geom of the world, or of a body that is fixed to it."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return RigidTransform(RotationMatrix(data.geom_xmat[geom].reshape(3, 3)), data.geom_xpos[geom])


def _shape(model: mujoco.MjModel, geom: int):
    """Return Drake's shape of a geom."""
    size = model.geom_size[geom]
    kinds = mujoco.mjtGeom
    kind = model.geom_type[geom]
    if kind == kinds.mjGEOM_SPHERE:
        return Sphere(size[0])
    if kind == kinds.mjGEOM_CAPSULE:
        return Capsule(size[0], 2.0 * size[1])
    if kind == kinds.mjGEOM_CYLINDER:
        return Cylinder(size[0], 2.0 * size[1])
    if kind == kinds.mjGEOM_BOX:
        return Box(*(2.0 * size))
    if kind == kinds.mjGEOM_ELLIPSOID:
        return Ellipsoid(*size)
    raise ValueError(
        f"robot.xml: geom {geom} touches the ground and is no sphere, capsule, cylinder, box or ellipsoid"
    )


def _material(friction: float) -> ProximityProperties:
    found = ProximityProperties()
    AddContactMaterial(
        dissipation=DISSIPATION,
        point_stiffness=STIFFNESS,
        friction=CoulombFriction(friction, friction),
        properties=found,
    )
    return found


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
