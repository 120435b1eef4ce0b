"""Proposes a robot with servos from an unknown robot's build, and reads the drives that its model has."""

import dataclasses

import mujoco

from ksim_rl.scene.actuators import PositionActuator
from ksim_rl.scene.names import actuators_of_joint, scalar_joint_ids
from ksim_rl.scene.robots.anatomy import Anatomy, posed, rounded
from ksim_rl.scene.robots.edit import Site
from ksim_rl.scene.robots.legged_robot import ModelRobot
from ksim_rl.scene.robots.strangers_model import StrangersModel
from ksim_rl.scene.state.joint_control import both_ways, effort_limit, joint_control

LEAST_SCALE = 0.15
MOST_SCALE = 0.5
"""rad per unit action: stiff servos saturate within less than a step, soft ones only beyond what legs can do."""


def propose(
    model: StrangersModel,
    data: mujoco.MjData,
    anatomy: Anatomy,
    servos: dict[int, dict[str, float]],
) -> ModelRobot:
    """Return the robot in the pose of `data` with servos by joint; bodies whose hulls touch there may pass."""
    mj_model = data.model
    every_joint = scalar_joint_ids(mj_model)
    root_at = int(mj_model.jnt_qposadr[mj_model.jnt_type.argmin()])
    # Adding 0 turns -0 into 0, for code that is read by people.
    quat = data.qpos[root_at + 3 : root_at + 7]
    w, x, y, z = (round(float(value), 6) + 0.0 for value in quat)
    positions = rounded(data.qpos[mj_model.jnt_qposadr[every_joint]])
    stance = {
        mj_model.joint(j).name: position for j, position in zip(every_joint, positions, strict=True)
    }
    names = {j: mj_model.joint(j).name for j in servos}
    # Joints with equal servos share an entry.
    alike: dict[tuple[float, ...], list[int]] = {}
    scales = {}
    for j, servo in servos.items():
        alike.setdefault(tuple(servo.values()), []).append(j)
        # A quarter of the error at which the servo saturates.
        scale = 0.25 * servo["effort_limit"] / servo["stiffness"]
        scales[names[j]] = round(min(max(scale, LEAST_SCALE), MOST_SCALE), 3)
    actuators = []
    for group in alike.values():
        joints = tuple(names[j] for j in group)
        actuators.append(PositionActuator(joints=joints, **servos[group[0]]))
    soles = tuple(geom for leg in anatomy.legs for geom in leg.geoms)
    sites = []
    for leg in anatomy.legs:
        foot = data.body(leg.foot)
        # The middle of the tread, in the foot's own frame.
        tread = (leg.points(data).mean(0) - foot.xpos) @ foot.xmat.reshape(3, 3)
        sites.append(Site(name=leg.foot, body=leg.foot, pos=rounded(tread)))
    if not any(site.name == "imu" for site in model.spec.sites):
        sites.append(Site(name="imu", body=anatomy.root))
    robot = ModelRobot(
        name=model.name,
        model=model.source,
        root_body=anatomy.root,
        joint_names=tuple(names.values()),
        init_pos=(0.0, 0.0, round(float(data.body(anatomy.root).xpos[2]), 4)),
        init_quat=(w, x, y, z),
        default_joint_pos=stance,
        action_scale=scales,
        actuators=tuple(actuators),
        foot_geoms=tuple(geom.name for geom in soles),
        foot_sites=tuple(leg.foot for leg in anatomy.legs),
        collision_geoms=(*anatomy.hulls, *soles),
        sites=tuple(sites),
        dropped=model.dropped,
        free_root=model.frees_root,
        root_turn=model.root_turn,
    )
    # Hulls that touch in the stance would push the robot apart: their bodies pass through each other.
    trial = robot.spec().compile()
    contacts = posed(trial, trial.key_qpos[0]).contact.geom
    touching = set()
    for first, second in contacts:
        bodies = trial.geom_bodyid[first], trial.geom_bodyid[second]
        touching.add((trial.body(bodies[0]).name, trial.body(bodies[1]).name))
    return dataclasses.replace(robot, overlaps=tuple(sorted(touching)))


def drive_of(
    mj_model: mujoco.MjModel, joint: int, *, most: float
) -> tuple[str, tuple[float, float], float | None]:
    """Return a joint's kind of drive in the model, stiffness and damping, and the least of all limits of its effort.

    A limit above `most` is no limit.
    """
    kind = "none"
    gains = (0.0, 0.0)
    for a in actuators_of_joint(mj_model, joint):
        control = joint_control(mj_model, a)
        target = control.kind
        kind = {"pos": "position", "vel": "velocity", "effort": "motor"}[target]
        if target != "effort":
            gains = abs(control.stiffness), abs(control.damping)
    limit = effort_limit_of(mj_model, joint, most=most)
    return kind, gains, None if limit is None else three_digits(limit)


def effort_limit_of(mj_model: mujoco.MjModel, joint: int, *, most: float) -> float | None:
    """Return the least limit of a joint's effort both ways, N m or N; None where there is none below `most`."""
    limits = []
    if mj_model.jnt_actfrclimited[joint]:
        limits.append(both_ways(mj_model.jnt_actfrcrange[joint]))
    for a in actuators_of_joint(mj_model, joint):
        limit = effort_limit(mj_model, a)
        if limit is not None:
            limits.append(limit)
    limits = [limit for limit in limits if 0.0 < limit < most]
    return min(limits, default=None)


def three_digits(number: float) -> float:
    """Return a number to three significant digits."""
    return float(f"{number:.3g}")
