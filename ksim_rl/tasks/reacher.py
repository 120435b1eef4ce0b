"""A planar arm brings its finger to a target; after the reacher of dm_control's suite (Tassa et al., 2018).

Their reward is 1 inside the target and 0 elsewhere; ours rates the way there too.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.checked import NonNegativeRange
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import CommandTerm, ObservationTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tracking import tolerance
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.robots.control_models import Reacher
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import small_networks
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

TARGET_RADIUS = 0.015


@dataclass(frozen=True, kw_only=True)
class ReacherTarget(CommandTerm):
    """A point in the finger's plane, x and y in the world frame, m, [E, 2], uniform by area on a ring about the hub.

    Attributes:
        radius: m, inner and outer radius of the ring.
    """

    radius: NonNegativeRange = (0.06, 0.22)

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        share_E, angle_E = view.uniform(2).unbind(-1)
        inner, outer = self.radius
        radius_E = torch.sqrt(inner**2 + share_E * (outer**2 - inner**2))
        angle_E = 2.0 * torch.pi * angle_E
        drawn_E2 = radius_E[:, None] * torch.stack((torch.cos(angle_E), torch.sin(angle_E)), dim=-1)
        held_E2 = self._held(view)
        held_E2.copy_(torch.where(mask_E[:, None], drawn_E2, held_E2))

    def __call__(self, view: EnvView) -> Float[Tensor, "E 2"]:
        return self._held(view).clone()

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the target."""
        x, y = self._held(view)[env_index].tolist()
        visualizer.sphere((x, y, Reacher.plane_height), radius=TARGET_RADIUS, rgba=(0.2, 0.6, 0.2, 0.8))

    def _held(self, view: EnvView) -> Float[Tensor, "E 2"]:
        return view.buffer("target_E2", 2)


@dataclass(frozen=True, kw_only=True)
class ReacherPose(ObservationTerm):
    """Cosine and sine of the shoulder's angle, and the wrist's angle, rad, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        shoulder_E1, wrist_E1 = view.joint_pos_EL.split(1, dim=-1)
        return torch.cat((torch.cos(shoulder_E1), torch.sin(shoulder_E1), wrist_E1), dim=-1)


@dataclass(frozen=True, kw_only=True)
class FingerToTarget(ObservationTerm):
    """Target minus finger, x and y in the world frame, m, [E, 2]; position stage.

    Attributes:
        command: a `ReacherTarget`.
    """

    command: str = "target"

    def __call__(self, view: EnvView) -> Float[Tensor, "E 2"]:
        return _offset(view, self.command)


@dataclass(frozen=True, kw_only=True)
class ReacherReward(RewardTerm):
    """1 where the finger is inside the target, 0.1 at 0.1 m from it, in [0, 1]; position stage."""

    command: str = "target"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        distance_E = torch.linalg.vector_norm(_offset(view, self.command), dim=-1)
        return tolerance(distance_E, high=TARGET_RADIUS, margin=0.1)


def _offset(view: EnvView, command: str) -> Float[Tensor, "E 2"]:
    """Return target minus finger, x and y in the world frame, m, [E, 2]."""
    return view.command(command) - view.site("finger").pos_EL[:, :2]


def reacher() -> ManagerBasedRlEnvCfg:
    """Return the config of reaching one target per episode."""
    terms = {
        "pose": ObservationTermCfg(term=ReacherPose()),
        "velocity": ObservationTermCfg(term=mdp.JointVel()),
        "to_target": ObservationTermCfg(term=FingerToTarget()),
    }
    return ManagerBasedRlEnvCfg(
        decimation=2,
        scene=SceneCfg(robots={"reacher": Reacher()}, num_envs=1024),
        observations={"actor": ObservationGroupCfg(terms=terms), "critic": ObservationGroupCfg(terms=terms)},
        actions={"torque": mdp.JointEffortAction(joints=("shoulder", "wrist"))},
        events={
            "shoulder": mdp.ResetJoints(joints="shoulder", position_range=(-torch.pi, torch.pi)),
            "wrist": mdp.ResetJoints(joints="wrist", position_range=(-2.7, 2.7)),
        },
        commands={"target": ReacherTarget(resampling_time_range_s=(20.0, 20.0))},
        rewards={"reach": ReacherReward()},
        terminations={"time_out": mdp.TimeOut(time_out=True)},
        episode_length_s=20.0,
        scale_rewards_by_dt=False,
        viewer=ViewerCfg(lookat=(0.0, 0.0, 0.0), distance=0.8, elevation=-60.0, azimuth=90.0),
    )


REACHER = Task(
    name="reacher",
    description="a planar arm reaches a point",
    cfg=reacher,
    training=small_networks.training(
        num_envs=512,
        data=DatasetCfg(num_env_states_per_minibatch=4096, num_minibatches=4),
        num_iterations=150,
        learning_rate=1e-3,
        num_epochs=6,
        entropy_coeff=0.0,
    ),
    # On the target from 1 s on (950 of 1000 steps), with nothing before that.
    solved_at=930.0,
)
