"""Analyses an unknown robot: the facts of its model, and all that a walking task needs."""

import dataclasses
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image
from rich.console import Console
from rich.pretty import pretty_repr
from rich.table import Table

from ksim_rl.files.writing import whole_file
from ksim_rl.physics.capacity import probe
from ksim_rl.physics.load import Source
from ksim_rl.scene.names import scalar_joint_ids
from ksim_rl.scene.rendering.rendering import choose_gl_platform
from ksim_rl.scene.rendering.visualizer import visible_groups
from ksim_rl.scene.robots.anatomy import dissect, posed
from ksim_rl.scene.robots.legged_robot import ModelRobot
from ksim_rl.scene.robots.passive import passive_joints
from ksim_rl.scene.robots.proposal import drive_of, propose, three_digits
from ksim_rl.scene.robots.stance import find_stance, on_plane, stand
from ksim_rl.scene.robots.starting_poses import StartingPose, starting_poses
from ksim_rl.scene.robots.strangers_model import StrangersModel, read_model

FREQUENCY = 10.0
DAMPING_RATIO = 2.0
"""Of a joint's motor alone under its servo, Hz; as in BeyondMimic (Liao et al., 2025)."""
ARMATURE_PER_EFFORT = 2e-4
"""kg m^2 per N m for a model without armature: geared motors of Go1 and G1 have 1.1e-4 to 2.5e-4."""
SOFTEST = 0.25
MOST_SAG = 0.1
"""rad: from which error on a servo may saturate whatever its armature, and what the load in the stance may bend it."""
MOST_EFFORT = 1000.0
"""Times weight and height of the centre of mass: where a file says more, its author meant that nothing limits it."""
TRIAL_S = 5.0
TRIALS = 6
STIFFER = 1.5
"""The legs' stiffness is multiplied until the robot stands that long and straight, so often at most."""
GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class JointAnalysis:
    """One joint as it is in the model, and from `stance` on as it is proposed; rad, N m and kg m^2 (or m, N, kg).

    `gains` are stiffness and damping of the model's own `actuator`, `load` is the torque that holds the joint in the
    stance, and `sag` how far it is from its target after standing.
    """

    name: str
    actuator: str
    limits: tuple[float, float] | None
    gains: tuple[float, float]
    effort_limit: float
    armature: float
    damping: float
    frictionloss: float
    load: float
    stance: float
    stiffness: float
    servo_damping: float
    action_scale: float
    sag: float


@dataclass(frozen=True, kw_only=True)
class RobotAnalysis:
    """The findings of `analyse`: the joints as they are, and `robot`, a `LeggedRobot` of all that is proposed.

    Attributes:
        mass, height: kg, and m from the lowest point to the highest in the model's own pose.
        com_height: m of the centre of mass above the soles in the stance.
        pitch_joints: joints of the legs that turn about y.
        ankle_stiffness_ratio: of all ankles about y, over m g h; a biped needs more than 1 to stand without a policy.
        knee_sag: rad, the most that a pitch joint gives way.
        stands_s, drift: s until it falls with zero actions in MuJoCo's C engine (at most 5), and m that it moves.
        pose: the keyframe that the stance was found from, or "qpos0".
        passive_joints: joints without a motor, in the model and in the proposal.
        notes: assumptions, changes and omissions.
    """

    robot: ModelRobot
    mass: float
    height: float
    com_height: float
    joints: tuple[JointAnalysis, ...]
    foot_bodies: tuple[str, ...]
    leg_joints: tuple[str, ...]
    pitch_joints: tuple[str, ...]
    ankle_stiffness_ratio: float | None
    knee_sag: float
    stands_s: float
    drift: float
    njmax: int
    nconmax: int
    pose: str
    passive_joints: tuple[str, ...]
    notes: tuple[str, ...]

    def by_joint(self, pitch: float, legs: float, others: float) -> dict[str, float]:
        """Return a value by joint pattern: for the legs' joints that turn about y, their others, and all others."""
        values = dict.fromkeys(self.robot.default_joint_pos, others) | dict.fromkeys(
            self.leg_joints, legs
        )
        by_pattern = {}
        for joint, value in values.items():
            if joint in self.pitch_joints:
                by_pattern[re.escape(joint)] = pitch
            else:
                by_pattern[re.escape(joint)] = value
        return by_pattern

    def table(self) -> str:
        """Return the report as text."""
        robot = self.robot
        ratio = self.ankle_stiffness_ratio
        if ratio is None:
            ankles = ""
        else:
            ankles = f", ankle stiffness {ratio:.1f} m g h"
        lines = [
            f"{robot.name}: {self.mass:.2f} kg, {self.height:.2f} m, root {robot.root_body}",
            f"feet: {', '.join(self.foot_bodies)}",
            f"stance from {self.pose}: root {robot.init_pos[2]:.3f} m, centre of mass {self.com_height:.3f} m over the "
            f"soles{ankles}",
            f"zero actions: stands {self.stands_s:g} s, moves {self.drift:.3f} m, knees sag {self.knee_sag:.3f} rad",
            f"collisions: {len(robot.collision_geoms)} geoms, njmax={self.njmax}, nconmax={self.nconmax}",
            *(f"note: {note}" for note in self.notes),
        ]
        table = Table(box=None, pad_edge=False, header_style="bold")
        heads = "joint|actuator|range|kp|kd|effort|armature|damping|friction|load|: stance|kp|kd|scale|sag"
        for head in heads.split("|"):
            table.add_column(
                head, justify="left" if head in ("joint", "actuator") else "right", no_wrap=True
            )
        for joint in self.joints:
            name, actuator, limits, gains, *numbers = dataclasses.astuple(joint)
            if limits is None:
                span = "-"
            else:
                span = f"{limits[0]:.2f} {limits[1]:.2f}"
            table.add_row(name, actuator, span, *(f"{number:.3g}" for number in (*gains, *numbers)))
        text = io.StringIO()
        Console(file=text, force_jupyter=False, width=240, highlight=False).print(table)
        return "\n".join([*lines, "", text.getvalue()])

    def code(self) -> str:
        """Return a Python module with `robot`, to be edited, and its velocity task."""
        name = self.robot.name.upper()
        return f'''"""{self.robot.name} follows a velocity command."""

from ksim_rl.envs.actuators import PositionActuator
from ksim_rl.envs.robots import ModelRobot
from ksim_rl.envs.tasks import velocity
from ksim_rl.scene.robots.edit import CollisionGeom, Site

{name} = {pretty_repr(self.robot, max_width=140)}
TASK = velocity.VelocityTask.for_robot({name})
'''

    def draw(self, file: Path) -> None:
        """Write a picture of the stance, 640 x 480."""
        choose_gl_platform()
        mj_model = on_plane(self.robot.spec())
        camera = mujoco.MjvCamera()
        camera.lookat[2] = self.com_height
        camera.distance = 2.5 * max(self.height, 0.5)
        camera.azimuth = 130.0
        camera.elevation = -15.0
        with mujoco.Renderer(mj_model, 480, 640) as renderer:
            renderer.update_scene(
                posed(mj_model, mj_model.key_qpos[0]), camera, visible_groups(mj_model)
            )
            picture = Image.fromarray(renderer.render())
        with whole_file(file) as temporary:
            picture.save(temporary)


def analyse(source: Source, *, pose: str | None = None, drop: Sequence[str] = ()) -> RobotAnalysis:
    """Analyse a legged robot from a source for `physics.load_spec`: a file, a menagerie name, XML or a spec.

    Bodies to `drop` are left out, with all that hangs on them: props with a free joint of their own, for instance.

    Keyframes and the model's own pose, "qpos0", are tried in this order, but for those in which the robot lies; the
    first from which it stands is taken, or else that from which it stands longest. `pose` names the one to take.

    Gains follow from armature and `FREQUENCY`, for motors and position servos alike: a `PositionActuator` is a torque
    motor under PD control. They are raised where the load would bend a joint by more than `MOST_SAG`, to twice the
    stiffness that keeps a joint's load from toppling over it, and in the legs until the robot stands.
    """
    model = read_model(source, drop)
    found: list[RobotAnalysis] = []
    refused: list[ValueError] = []
    for start in starting_poses(model.mj_model, pose):
        # A pose in which the robot cannot stand is refused; another one may do.
        try:
            found.append(_analyse_from(model, start))
        except ValueError as error:
            refused.append(error)
            continue
        if found[-1].stands_s >= TRIAL_S:
            return found[-1]
    # The first refusal is about the pose with the highest priority.
    if not found:
        raise refused[0]
    return max(found, key=lambda analysis: analysis.stands_s)


def _analyse_from(model: StrangersModel, start: StartingPose) -> RobotAnalysis:
    """Analyse a robot that stands upright in a pose."""
    model, given = model.turned_upright(start.qpos)
    mj_model = model.mj_model
    anatomy = dissect(mj_model, given)
    legs = anatomy.legs
    biped = len(anatomy.legs) == 2
    passive = passive_joints(mj_model)
    # From here on in the stance: all soles flat, the centre of mass over them.
    data = posed(mj_model, find_stance(mj_model, legs, given, passive=passive))
    names = {j: mj_model.joint(j).name for j in scalar_joint_ids(mj_model) if j not in passive}
    of_legs = []
    for leg in legs:
        # Legs may share joints, which must count once.
        of_legs += [j for j in leg.joints if j in names and j not in of_legs]
    dof = mj_model.jnt_dofadr
    com_height = float(data.subtree_com[0, 2])
    if com_height <= 0.0:
        raise ValueError(
            f"in pose {start.name!r} the soles lie over the centre of mass: the robot does not stand in it"
        )
    weight = float(mj_model.body_subtreemass[0]) * GRAVITY
    # The torques that hold the pose while all feet carry the same weight.
    load = data.qfrc_bias.copy()
    jacobian = np.zeros((3, mj_model.nv))
    for leg in legs:
        mujoco.mj_jac(
            mj_model, data, jacobian, None, leg.points(data).mean(0), data.body(leg.foot).id
        )
        load -= jacobian[2] * weight / len(legs)
    most = MOST_EFFORT * weight * com_height
    given_drives = {j: drive_of(mj_model, j, most=most) for j in names}
    # For joints whose file names no limit: half of m g h, to three digits for small robots.
    usual = 0.5 * weight * com_height
    if usual > 1.0:
        usual = round(usual, 1)
    else:
        usual = three_digits(usual)
    efforts = {j: limit or usual for j, (_, _, limit) in given_drives.items()}
    inertias = {
        j: three_digits(mj_model.dof_armature[dof[j]] or ARMATURE_PER_EFFORT * efforts[j])
        for j in names
    }
    # Stiffness by joint: the largest of three needs.
    gains = {}
    for j in names:
        if j not in of_legs:
            # Any other joint carries its own subtree.
            over = mj_model.jnt_bodyid[j]
            share = 1.0
        else:
            # A leg's joint carries the whole robot. Two legs share the load; on four, toppling over a single joint is
            # not to be feared.
            over = 0
            share = 0.5 if biped else 0.0
        # Only height over a horizontal axis topples: m of lever per rad.
        lever = np.hypot(*data.xaxis[j, :2]) * max(
            0.0, data.subtree_com[over, 2] - data.xanchor[j, 2]
        )
        topples = share * mj_model.body_subtreemass[over] * GRAVITY * lever
        # First need: a natural frequency for the motor alone, but too soft to saturate below an error of `SOFTEST`.
        own = min(inertias[j] * (2.0 * math.pi * FREQUENCY) ** 2, efforts[j] / SOFTEST)
        gains[j] = max(own, abs(load[dof[j]]) / MOST_SAG, 2.0 * topples)
    # Left and right get the same gains, joint by joint from the hip down.
    for joints in zip(*(leg.joints for leg in legs), strict=False):
        alike = [j for j in joints if j in gains]
        gains |= dict.fromkeys(alike, max((gains[j] for j in alike), default=0.0))

    pitch = []
    for leg in legs:
        pitch.append([j for j in leg.pitch_joints(data) if j in names])
    trials = []
    while not trials or (trials[-1][:2] < (TRIAL_S, -1.5 * MOST_SAG) and len(trials) < TRIALS):
        # Each trial holds the legs by stiffer servos than the last one.
        stiffer = dict.fromkeys(names, 1.0) | dict.fromkeys(of_legs, STIFFER ** len(trials))
        servos = {}
        for j, kp in gains.items():
            kp = three_digits(kp * stiffer[j])
            kd = three_digits(2.0 * DAMPING_RATIO * math.sqrt(kp * inertias[j]))
            servos[j] = {
                "stiffness": kp,
                "damping": kd,
                "effort_limit": efforts[j],
                "armature": inertias[j],
            }
        robot = propose(model, data, anatomy, servos)
        mj_stand = on_plane(robot.spec())
        standing = stand(mj_stand, seconds=TRIAL_S)
        sag = max((abs(standing.sag[names[j]]) for joints in pitch for j in joints), default=0.0)
        trials.append((standing.seconds, -sag, standing, robot, servos, mj_stand))
    _, sag, standing, robot, servos, mj_stand = max(trials, key=lambda trial: trial[:2])

    # The last pitch joint of a leg is its ankle.
    ankles = sum(servos[joints[-1]]["stiffness"] for joints in pitch if joints)
    assumed = {
        "effort limit, half of weight times height": [
            names[j] for j, (_, _, limit) in given_drives.items() if not limit
        ],
        f"armature, {ARMATURE_PER_EFFORT:g} x effort limit": [
            names[j] for j in names if not mj_model.dof_armature[dof[j]]
        ],
    }
    left_passive = tuple(mj_model.joint(j).name for j in passive)
    notes = [f"no {what} is assumed: {', '.join(of)}" for what, of in assumed.items() if of]
    if left_passive:
        notes.append(f"no motor, and none is given: {', '.join(left_passive)}")
    njmax, nconmax = probe(mj_stand)
    return RobotAnalysis(
        robot=robot,
        mass=weight / GRAVITY,
        height=anatomy.height,
        com_height=com_height,
        joints=tuple(
            JointAnalysis(
                name=name,
                limits=tuple(mj_model.jnt_range[j].tolist()) if mj_model.jnt_limited[j] else None,
                actuator=given_drives[j][0],
                gains=given_drives[j][1],
                effort_limit=efforts[j],
                armature=float(mj_model.dof_armature[dof[j]]),
                damping=float(mj_model.dof_damping[dof[j]]),
                frictionloss=float(mj_model.dof_frictionloss[dof[j]]),
                load=float(load[dof[j]]),
                stance=robot.default_joint_pos[name],
                stiffness=servos[j]["stiffness"],
                servo_damping=servos[j]["damping"],
                action_scale=robot.action_scale[name],
                sag=standing.sag[name],
            )
            for j, name in names.items()
        ),
        foot_bodies=robot.foot_sites,
        leg_joints=tuple(names[j] for j in of_legs),
        pitch_joints=tuple(dict.fromkeys(names[j] for joints in pitch for j in joints)),
        ankle_stiffness_ratio=ankles / (weight * com_height) if biped else None,
        knee_sag=-sag,
        stands_s=standing.seconds,
        drift=standing.drift,
        njmax=njmax,
        nconmax=nconmax,
        pose=start.name,
        passive_joints=left_passive,
        notes=(*notes, *model.notes),
    )
