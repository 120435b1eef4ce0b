"""Unitree G1 takes a box off a stand between its palms, and carries it to a place in the air.

Rewards have no stages: palms at the sides of the box, a box that is up, and one that is near its place each pay by
themselves, and the place pays only as far as the box is up, so that pushing it off the stand pays nothing.
"""

import dataclasses
from dataclasses import dataclass

import mujoco
from jaxtyping import Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.checked import Positive
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import EventTerm, ObservationTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.pose import OfTarget
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import GaussianReward
from ksim_rl.mdp.randomization.shapes import geom_size, reach_down
from ksim_rl.modules import ActorCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.objects import Box, Stand
from ksim_rl.scene.robots.unitree_g1 import SIDES, UnitreeG1
from ksim_rl.scene.scene import Placement, SceneCfg
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity
from ksim_rl.tasks.velocity import noisy
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

ROBOT = UnitreeG1()
COMMAND = "place"
BOX = "box/box"
EDGE = 0.26
STAND_HEIGHT = 0.7
"""m, of the box and of the stand: its middle is then as high as the hands of bent arms."""
AHEAD = 0.36
"""m from the robot to the middle of the box at the start: arms that are half a metre long reach its sides."""
RISE = 0.06
"""m above where it stood: the box counts as lifted."""
PALM_ROOM = 0.04
"""m between a palm and the side of the box that it holds: the hand's own thickness."""
ENV_STATES_PER_ITERATION = 24 * 4096


def of_robot(name: str) -> str:
    """Return the name that an element of the robot has in the scene."""
    return f"{ROBOT.name}/{name}"


JOINTS = tuple(of_robot(joint) for joint in ROBOT.joint_names)
PALMS = tuple(of_robot(f"{side}_palm") for side in SIDES)


@dataclass(frozen=True, kw_only=True)
class PlaceFromRoot(OfTarget, ObservationTerm):
    """A commanded place minus where a body or site is, in the frame of the robot's root, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        return quaternion.rotate_inverse(view.robot.root_quat_EL, self.offset(view))


@dataclass(frozen=True, kw_only=True)
class PalmsAtSides(GaussianReward):
    """exp(-mean_p d_p^2 / std^2), `d` from palms to where they hold a box, m, [E]; position stage.

    The first palm belongs to the box's y side, the second to the other one, each `room` (m) off it.

    Attributes:
        palms: two sites.
        body, geom: the box and its geom, whose size may differ from world to world.
    """

    palms: Patterns
    body: str
    geom: str
    room: Positive

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        box = view.body(self.body)
        half_E1 = _half_edges(view, self.geom)[:, 1:2] + self.room
        # Along the box's y axis, to the one side and to the other.
        beside_23 = constant((0.0, 1.0, 0.0, 0.0, -1.0, 0.0), view.device).view(2, 3)
        wanted_EN3 = quaternion.rotate(box.quat_EL[:, None], half_E1[:, None] * beside_23)
        wanted_EN3 = wanted_EN3 + box.pos_EL[:, None]
        away_EN3 = view.sites(self.palms).pos_EN3 - wanted_EN3
        return self.rate(away_EN3.square().sum(-1).mean(-1))


@dataclass(frozen=True, kw_only=True)
class Lifted(RewardTerm):
    """How far the lowest corner of a box is above a stand, as a fraction of `rise`, in [0, 1], [E]; position stage.

    Attributes:
        body, geom: the box and its geom.
        stand, rise: the height of the stand, and the height above it at which the box counts as lifted, m.
    """

    body: str
    geom: str
    stand: Positive
    rise: Positive

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        box = view.body(self.body)
        # A box that is tipped onto an edge has its middle higher, and is not lifted.
        down_E = reach_down(mujoco.mjtGeom.mjGEOM_BOX, _half_edges(view, self.geom), box.quat_EL)
        height_E = box.pos_EL[:, 2] - down_E - self.stand
        return (height_E / self.rise).clamp(0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class CarriedToPlace(OfTarget, GaussianReward):
    """exp(-d^2 / std^2) times `lifted`, `d` the distance of a body from the commanded place, m, [E]; position stage."""

    lifted: Lifted

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.rate(self.distance(view).square()) * self.lifted(view)


def _half_edges(view: EnvView, geom: str) -> Float[Tensor, "E 3"]:
    """Return half of the edges of a box in each world, m."""
    return geom_size(view, view.resolver.one("geom", geom))


def _scene() -> SceneCfg:
    root = of_robot(ROBOT.root_body)
    itself = ContactSensor(
        subtrees=(root,),
        against=root,
        against_kind="subtree",
        reduce="strongest",
        every_substep=True,
    )
    return SceneCfg(
        robots={ROBOT.name: ROBOT},
        objects={
            "box": Box(size=(EDGE, EDGE, EDGE), mass=0.6, friction=(1.2, 0.01, 0.001)),
            "stand": Stand(size=(0.2, 0.2, STAND_HEIGHT)),
        },
        placements={
            "box": Placement(pos=(AHEAD, 0.0, STAND_HEIGHT)),
            "stand": Placement(pos=(AHEAD, 0.0, 0.0)),
        },
        terrain=PlaneTerrain(),
        sensors={velocity.SELF: itself},
        num_envs=4096,
        soft_joint_pos_limit_factor=ROBOT.soft_joint_pos_limit_factor,
    )


def _observations() -> dict[str, ObservationGroupCfg]:
    """Return the groups: a noisy "actor", and a clean "critic" that also sees velocities of root and box."""
    # Term and reach of its uniform noise, in the term's units.
    reaches = {
        "base_ang_vel": (mdp.SensorReading(sensor=of_robot("imu_ang_vel")), 0.2),
        "projected_gravity": (mdp.ProjectedGravity(), 0.05),
        "joint_pos": (mdp.JointPosRel(joints=JOINTS), 0.01),
        "joint_vel": (mdp.JointVel(joints=JOINTS), 0.5),
        "box_pos": (mdp.BodyPos(bodies=BOX), 0.01),
        "box_rotation": (mdp.BodyRotation6d(bodies=BOX), 0.02),
        "to_place": (PlaceFromRoot(command=COMMAND, body=BOX, frame="world"), 0.01),
    }
    last = {"actions": ObservationTermCfg(term=mdp.LastAction())}
    clean = {name: ObservationTermCfg(term=term) for name, (term, _) in reaches.items()}
    seen = {name: noisy(term, reach) for name, (term, reach) in reaches.items()}
    velocities = {
        "base_lin_vel": ObservationTermCfg(term=mdp.SensorReading(sensor=of_robot("imu_lin_vel"))),
        "box_lin_vel": ObservationTermCfg(term=mdp.BodyLinVel(bodies=BOX)),
        "root_height": ObservationTermCfg(term=mdp.RootPos()),
    }
    return {
        "actor": ObservationGroupCfg(terms={**seen, **last}),
        "critic": ObservationGroupCfg(terms={**clean, **last, **velocities}),
    }


def _rewards() -> dict[str, RewardTerm]:
    lifted = Lifted(body=BOX, geom=BOX, stand=STAND_HEIGHT, rise=RISE)
    held = {"palms": PALMS, "body": BOX, "geom": BOX, "room": PALM_ROOM}
    place = {"command": COMMAND, "body": BOX, "frame": "world", "lifted": lifted}
    return {
        # A wide and a narrow one of each: the wide one leads there, the narrow one asks for precision.
        "palms_coarse": PalmsAtSides(**held, std=0.3, weight=0.5),
        "palms": PalmsAtSides(**held, std=0.08, weight=1.0),
        "lifted": dataclasses.replace(lifted, weight=1.0),
        "place_coarse": CarriedToPlace(**place, std=1.0, weight=2.0),
        "place": CarriedToPlace(**place, std=0.15, weight=2.0),
        "upright": mdp.Upright(std=0.4, weight=0.5),
        "posture": mdp.JointDeviationL2(joints=JOINTS, weight=-0.02),
        "action_rate_l2": mdp.ActionRateL2(weight=-0.05),
        "dof_pos_limits": mdp.JointPosLimits(joints=JOINTS, weight=-5.0),
        "self_collisions": mdp.SelfCollision(weight=-1.0, sensor=velocity.SELF),
        "failed": mdp.Terminated(weight=-100.0),
    }


def _events() -> dict[str, EventTerm]:
    feet = tuple(of_robot(geom) for geom in ROBOT.foot_geoms)
    sideways: mdp.Ranges = {"x": (-0.03, 0.03), "y": (-0.05, 0.05)}
    return {
        "robot": mdp.ResetRootUniform(pose_range={**sideways, "yaw": (-0.1, 0.1)}),
        "joints": mdp.ResetJoints(joints=JOINTS, position_range=(-0.05, 0.05)),
        # Edges of 23 to 29 cm, and 0.44 to 0.8 kg.
        "box_size": mdp.RandomizeSolidSize(
            geoms=BOX, ranges=(0.9, 1.1), operation="scale", constant="density"
        ),
        "box_friction": mdp.RandomizeGeomFriction(geoms=BOX, ranges={0: (1.0, 1.4)}),
        "box": mdp.ResetRootUniform(
            entity="box",
            pose_range={**dict.fromkeys(("x", "y"), (-0.02, 0.02)), "yaw": (-0.2, 0.2)},
        ),
        # Behind what draws its size and place.
        "box_on_stand": mdp.SetDown(entity="box", height=STAND_HEIGHT),
        "foot_friction": mdp.RandomizeGeomFriction(geoms=feet, ranges={0: (0.5, 1.2)}, shared=True),
        "push_robot": mdp.PushByVelocity(
            interval_range_s=(3.0, 5.0),
            velocity_range=dict.fromkeys(("x", "y"), (-0.2, 0.2)),
        ),
    }


def g1_carry_box() -> ManagerBasedRlEnvCfg:
    """Return the config: 50 Hz control, and a place behind or beside the robot for each episode of 10 s."""
    scale = {of_robot(joint): value for joint, value in ROBOT.action_scale.items()}
    return ManagerBasedRlEnvCfg(
        decimation=4,
        # A held box slips where friction is as soft as contact. Rows suffice for a robot that lies on its arms.
        sim=dataclasses.replace(velocity.sim(cone="elliptic", impratio=10.0), njmax=320),
        scene=_scene(),
        observations=_observations(),
        actions={"joint_pos": mdp.JointPositionAction(joints=JOINTS, scale=scale)},
        commands={
            COMMAND: mdp.CartesianCommand(
                frame="world",
                position={"x": (-1.2, -0.4), "y": (-0.8, 0.8), "z": (0.9, 1.05)},
                # As long as an episode, so that the place stays.
                resampling_time_range_s=(10.0, 10.0),
            )
        },
        rewards=_rewards(),
        events=_events(),
        terminations={
            "time_out": mdp.TimeOut(),
            "fallen": mdp.BadOrientation(limit_angle=1.0),
            "sunk": mdp.RootHeightBelow(minimum_height=0.4),
            "dropped": mdp.RootHeightBelow(entity="box", minimum_height=0.4),
        },
        # In the end: the box may pass its place earlier.
        metrics={
            "success": mdp.TargetReached(
                command=COMMAND, body=BOX, frame="world", tolerance=0.1, reduce="last"
            )
        },
        episode_length_s=10.0,
        viewer=ViewerCfg(lookat=(-0.2, 0.0, 0.7), distance=3.5, elevation=-15.0, azimuth=130.0),
    )


TASK = Task(
    name="g1_carry_box",
    description="Unitree G1 takes a box off a stand and carries it to a place in the air",
    cfg=g1_carry_box,
    training=TrainingCfg(
        num_envs=4096,
        seed=42,
        objective=PPOCfg(entropy_coeff=0.005, precision="auto"),
        data=DatasetCfg(
            num_env_states_per_minibatch=ENV_STATES_PER_ITERATION // 4, num_minibatches=4
        ),
        modules=ModulesCfg(actor=ActorCfg(init_std=0.5)),
        trainer=TrainerCfg(num_iterations=4_000),
    ),
)
