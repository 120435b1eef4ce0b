"""A planar biped walks as a recorded walk does.

`walker_track` follows the walk (Peng et al., "DeepMimic", 2018): episodes start anywhere in the motion, in its state
there, and end when the robot strays from it. The reward's parts are theirs; the robot's own root stands in for the
centre of mass. The reward of `walker_amp` asks for the speed alone (Peng et al., "AMP", arXiv 2104.02180): how to walk
is learned from the motion, as `objective=amp` compares the group "style"; the policy never sees the motion, nor where
in it it should be.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import MetricTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tracking import tolerance
from ksim_rl.objectives import AMPCfg
from ksim_rl.scene.motions.walker_walk import SPEED
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.robots.control_models import WALKER_SERVOS, Walker
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import planar
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

MOTION = "walker_walk"
CYCLE_S = 1.0
FEET = ("right_foot", "left_foot")


@dataclass(frozen=True, kw_only=True)
class WalkAt(RewardTerm):
    """1 at a forward speed within 0.1 m/s of `speed`, 0.1 where it is off by as much again as `speed`; velocity stage.

    Attributes:
        speed: m/s.
    """

    speed: float

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        low, high = self.speed - 0.1, self.speed + 0.1
        return tolerance(planar.forward_speed(view), low=low, high=high, margin=self.speed)


@dataclass(frozen=True, kw_only=True)
class PoseDistance(MetricTerm):
    """The root mean square of the joint angles' distance to the nearest pose of a motion, rad, [E]; position stage.

    Attributes:
        file: what `view.motion` reads.
        joints: names or patterns.
    """

    file: str
    joints: Patterns

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        joints = view.joints(self.joints)
        poses_FL, own_EL = view.motion(self.file).joint_pos_FL[:, joints.index], joints.pos_EL
        return torch.cdist(own_EL, poses_FL).amin(-1) / own_EL.shape[-1] ** 0.5


def _cfg(
    terms: Mapping[str, ObservationTermCfg], groups: Sequence[str] = ("actor", "critic"), **parts: Any
) -> ManagerBasedRlEnvCfg:
    """Put together what both tasks share: the robot, what it observes of itself and `terms`, and its servos."""
    own = {
        "gravity": ObservationTermCfg(term=mdp.ProjectedGravity()),
        "joint_pos": ObservationTermCfg(term=mdp.JointPos(joints=("root_z", Walker.joints))),
        "joint_vel": ObservationTermCfg(term=mdp.JointVel()),
    }
    robot = Walker(actuators=WALKER_SERVOS)
    return ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(robots={"walker": robot}, terrain=PlaneTerrain(), num_envs=2048),
        sim=planar.SIM,
        observations=dict.fromkeys(groups, ObservationGroupCfg(terms={**own, **terms})),
        actions={"legs": mdp.JointPositionAction(joints=Walker.joints, scale=0.5)},
        episode_length_s=8.0,
        viewer=ViewerCfg(body="torso", distance=4.0, elevation=-10.0, azimuth=90.0),
        **parts,
    )


def walker_amp() -> ManagerBasedRlEnvCfg:
    """Return the config of walking at the speed of the motion `walker_walk`."""
    return _cfg(
        {},
        ("actor", "critic", "style"),
        events={"reset": mdp.ResetToMotion(file=MOTION)},
        rewards={"walk": WalkAt(speed=SPEED)},
        terminations={"time_out": mdp.TimeOut(), "fallen": mdp.RootHeightBelow(minimum_height=0.8)},
        metrics={
            "forward_speed": planar.ForwardSpeed(),
            "pose_distance": PoseDistance(file=MOTION, joints=Walker.joints),
        },
        scale_rewards_by_dt=False,
    )


def walker_track() -> ManagerBasedRlEnvCfg:
    """Return the config of walking as the motion `walker_walk` does."""
    terms = {
        "phase": ObservationTermCfg(term=mdp.MotionPhase(file=MOTION, cycle_s=CYCLE_S)),
        "reference": ObservationTermCfg(term=mdp.MotionJoints(file=MOTION, joints=Walker.joints)),
        "drift": ObservationTermCfg(term=mdp.MotionBodyOffset(file=MOTION, bodies="torso")),
    }
    return _cfg(
        terms,
        events={"reset": mdp.ResetToMotion(file=MOTION, start_range=(0.0, 0.9))},
        rewards={
            "joint_pos": mdp.TrackMotionJointPos(file=MOTION, joints=Walker.joints, std=0.7, weight=0.65),
            "joint_vel": mdp.TrackMotionJointVel(file=MOTION, joints=Walker.joints, std=3.2, weight=0.1),
            "feet": mdp.TrackMotionBodyPos(file=MOTION, bodies=FEET, std=0.16, weight=0.15),
            "root": mdp.TrackMotionBodyPos(file=MOTION, bodies="torso", std=0.32, weight=0.05),
            "root_rotation": mdp.TrackMotionBodyQuat(file=MOTION, bodies="torso", std=0.32, weight=0.05),
            "action_rate": mdp.ActionRateL2(weight=-0.001),
        },
        terminations={
            "finished": mdp.MotionFinished(file=MOTION),
            "strayed": mdp.FarFromMotion(file=MOTION, bodies="torso", distance=0.4),
        },
    )


AMP = Task(
    name="walker_amp",
    description="a planar biped walks at 0.8 m/s, with objective=amp as a recorded walk does",
    cfg=walker_amp,
    training=planar.training(num_iterations=400),
    other_trainings=(
        planar.training(num_iterations=400, objective=AMPCfg(motions=(MOTION,), **planar.OBJECTIVE)),
    ),
)
TRACK = Task(
    name="walker_track",
    description="a planar biped follows a walk",
    cfg=walker_track,
    training=planar.training(num_iterations=400),
)
