"""A planar biped walks at a given speed in the style of a recorded walk (Peng et al., "AMP", arXiv 2104.02180).

The reward asks for the speed alone. How to walk is learned from the motion: `objective=amp` compares the group "style".
Unlike in `walker_track`, the policy never sees the motion, nor where in it it should be.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import MetricTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tolerance import tolerance
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


def walker_amp() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    terms = {
        "gravity": ObservationTermCfg(term=mdp.ProjectedGravity()),
        "joint_pos": ObservationTermCfg(term=mdp.JointPos(joints=("root_z", Walker.joints))),
        "joint_vel": ObservationTermCfg(term=mdp.JointVel()),
    }
    group = ObservationGroupCfg(terms=terms)
    return ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(
            robots={"walker": Walker(actuators=WALKER_SERVOS)}, terrain=PlaneTerrain(), num_envs=2048
        ),
        sim=planar.SIM,
        observations={"actor": group, "critic": group, "style": group},
        actions={"legs": mdp.JointPositionAction(joints=Walker.joints, scale=0.5)},
        events={"reset": mdp.ResetToMotion(file=MOTION)},
        rewards={"walk": WalkAt(speed=SPEED)},
        terminations={"time_out": mdp.TimeOut(), "fallen": mdp.RootHeightBelow(minimum_height=0.8)},
        metrics={
            "forward_speed": planar.ForwardSpeed(),
            "pose_distance": PoseDistance(file=MOTION, joints=Walker.joints),
        },
        episode_length_s=8.0,
        scale_rewards_by_dt=False,
        viewer=ViewerCfg(body="torso", distance=4.0, elevation=-10.0, azimuth=90.0),
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
