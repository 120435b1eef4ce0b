"""A small arm reaches points, and pushes a cube to a place on the table."""

from collections.abc import Mapping
from typing import Any

from ksim_rl import mdp
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import CommandTerm, EventTerm, MetricTerm, RewardTerm
from ksim_rl.modules import ActorCfg, CriticCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.physics import SimCfg
from ksim_rl.scene.objects import Box
from ksim_rl.scene.robots.control_models import Arm
from ksim_rl.scene.scene import Placement, SceneCfg
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

COMMAND = "target"
CUBE_EDGE = 0.06


def _cfg(
    scene: SceneCfg,
    *,
    prefix: str,
    observations: Mapping[str, ObservationTermCfg],
    command: CommandTerm,
    rewards: Mapping[str, RewardTerm],
    events: Mapping[str, EventTerm],
    metric: MetricTerm,
) -> ManagerBasedRlEnvCfg:
    """Put together the parts that both tasks share; `prefix` stands before the names of the arm's elements."""
    joints = tuple(f"{prefix}{joint}" for joint in Arm.joints)
    terms = {
        "joint_pos": ObservationTermCfg(term=mdp.JointPosRel(joints=joints)),
        # Divided by 5, since speeds reach several rad/s.
        "joint_vel": ObservationTermCfg(term=mdp.JointVel(joints=joints), scale=0.2),
        **observations,
        "last_action": ObservationTermCfg(term=mdp.LastAction()),
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        scene=scene,
        sim=SimCfg(iterations=10, ls_iterations=20),
        observations={
            "actor": ObservationGroupCfg(terms=terms),
            "critic": ObservationGroupCfg(terms=terms),
        },
        # A target is at most half a radian from where the joint is, so that the first policy moves slowly.
        actions={
            "joints": mdp.RelativeJointPositionAction(joints=joints, scale=0.2, clip=(-2.5, 2.5))
        },
        events={"arm": mdp.ResetJoints(joints=joints, position_range=(-0.1, 0.1)), **events},
        commands={COMMAND: command},
        rewards={
            **rewards,
            "action_rate": mdp.ActionRateL2(weight=-0.005),
            "joint_vel": mdp.JointVelL2(joints=joints, weight=-0.005),
        },
        terminations={"time_out": mdp.TimeOut(time_out=True)},
        metrics={"target_reached": metric},
        episode_length_s=8.0,
        viewer=ViewerCfg(lookat=(0.25, 0.0, 0.15), distance=1.4, elevation=-25.0, azimuth=140.0),
    )


def arm_reach() -> ManagerBasedRlEnvCfg:
    """Return the config of bringing the tip to points in front of the arm, a new one every 3 to 5 s."""
    here: dict[str, Any] = {"command": COMMAND, "site": Arm.tip}
    return _cfg(
        # A single entity keeps its plain names: no prefix.
        SceneCfg(robots={"arm": Arm()}, terrain=PlaneTerrain(), num_envs=2048),
        prefix="",
        observations={"to_target": ObservationTermCfg(term=mdp.OffsetToCommand(**here))},
        command=mdp.CartesianCommand(
            position={"x": (0.2, 0.45), "y": (-0.25, 0.25), "z": (0.05, 0.4)},
            resampling_time_range_s=(3.0, 5.0),
        ),
        rewards={
            # A wide and a narrow reward: the wide one leads there, the narrow one asks for precision.
            "coarse": mdp.TrackPosition(**here, std=0.25, weight=1.0),
            "fine": mdp.TrackPosition(**here, std=0.05, weight=1.0),
        },
        events={},
        metric=mdp.TargetReached(**here, tolerance=0.03, reduce="mean"),
    )


def arm_push() -> ManagerBasedRlEnvCfg:
    """Return the config of pushing a cube over the table to a place that stays for the episode."""
    # Names of a joined scene have the entity's prefix.
    cube = "cube/box"
    here: dict[str, Any] = {"command": COMMAND, "body": cube}
    return _cfg(
        SceneCfg(
            robots={"arm": Arm()},
            objects={"cube": Box(size=(CUBE_EDGE, CUBE_EDGE, CUBE_EDGE), mass=0.15)},
            placements={"cube": Placement(pos=(0.35, 0.0, 0.0))},
            terrain=PlaneTerrain(),
            num_envs=2048,
        ),
        prefix="arm/",
        observations={
            "to_cube": ObservationTermCfg(term=mdp.OffsetToBody(site=f"arm/{Arm.tip}", body=cube)),
            "to_target": ObservationTermCfg(term=mdp.OffsetToCommand(**here)),
            "cube_pos": ObservationTermCfg(term=mdp.RootPos(entity="cube")),
            "cube_rotation": ObservationTermCfg(term=mdp.RootRotation6d(entity="cube")),
            "cube_lin_vel": ObservationTermCfg(term=mdp.RootLinVel(entity="cube", frame="world")),
        },
        command=mdp.CartesianCommand(
            # The cube stays on the table: the target's height is half an edge.
            position={"x": (0.25, 0.45), "y": (-0.2, 0.2), "z": (CUBE_EDGE / 2, CUBE_EDGE / 2)},
            # As long as an episode, so that the target stays.
            resampling_time_range_s=(8.0, 8.0),
        ),
        rewards={
            # Leads the tip to the cube first, and is worth less than moving it.
            "near_cube": mdp.NearBody(site=f"arm/{Arm.tip}", body=cube, std=0.15, weight=0.5),
            "coarse": mdp.TrackPosition(**here, std=0.2, weight=1.0),
            "fine": mdp.TrackPosition(**here, std=0.05, weight=2.0),
        },
        events={
            "cube": mdp.ResetRootUniform(
                # About its placement, within the arm's reach.
                entity="cube",
                pose_range={"x": (-0.07, 0.05), "y": (-0.12, 0.12), "yaw": (-3.14, 3.14)},
            )
        },
        # In the end only: the cube may pass the target earlier.
        metric=mdp.TargetReached(**here, tolerance=0.04, reduce="last"),
    )


def _training(num_iterations: int) -> TrainingCfg:
    return TrainingCfg(
        num_envs=2048,
        objective=PPOCfg(entropy_coeff=0.003, clip_value=False),
        data=DatasetCfg(num_env_states_per_minibatch=12288, num_minibatches=4),
        modules=ModulesCfg(
            actor=ActorCfg(hidden_dims=(256, 128)), critic=CriticCfg(hidden_dims=(256, 128))
        ),
        trainer=TrainerCfg(num_iterations=num_iterations, eval_interval=50),
    )


# At its point in 6 of 8 s, in which both rewards are 1: a new one comes every 3 to 5 s, and a second is for the way.
REACH = Task(
    name="arm_reach",
    description="an arm brings its tip to points in space",
    cfg=arm_reach,
    training=_training(300),
    solved_at=12.0,
)
# The cube in its place, and the tip at the cube, in 6 of 8 s: rewards of 1, 2 and 0.5.
PUSH = Task(
    name="arm_push",
    description="an arm pushes a cube to a place on the table",
    cfg=arm_push,
    training=_training(1000),
    solved_at=21.0,
)
