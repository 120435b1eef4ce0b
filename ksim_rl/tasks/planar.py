"""The planar runners share this module: a robot in the xz plane, on the ground, is rated by posture and forward speed.

The tasks are those of dm_control's suite (Tassa et al., "DeepMind Control Suite", 2018) on robots of our own:
rewards in [0, 1], 1000 steps per episode, no early end. Unlike there, episodes start standing; who falls has to get up.
"""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import MetricTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.modules import ActorCfg, CriticCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.physics import SimCfg
from ksim_rl.scene.scene import Robot, SceneCfg
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

STEPS_PER_EPISODE = 1000
SIM = SimCfg(iterations=10, ls_iterations=20)


def height(view: EnvView) -> Float[Tensor, " E"]:
    """Return the torso's height, m, [E]; position stage."""
    return view.joints("root_z").pos_EL[:, 0]


def upright(view: EnvView) -> Float[Tensor, " E"]:
    """Return 1 where the torso is upright, 0 where it is upside down, linear in the cosine between, [E]."""
    return (1.0 - view.projected_gravity_EL[:, 2]) / 2.0


def forward_speed(view: EnvView) -> Float[Tensor, " E"]:
    """Return the velocity of the centre of mass along x, m/s, [E]; velocity stage."""
    return view.sensor("com_velocity")[:, 0]


def small_effort(view: EnvView) -> Float[Tensor, " E"]:
    """Return 1 without any action, 0 where each is at or beyond its limit, [E]."""
    return (1.0 - view.action_EL.clamp(-1.0, 1.0).square()).mean(-1)


@dataclass(frozen=True, kw_only=True)
class ForwardSpeed(MetricTerm):
    """Velocity of the centre of mass along x, m/s, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return forward_speed(view)


def planar_cfg(
    robot: Robot, *, motors: str, reward: RewardTerm, decimation: int, step_dt: float, distance: float
) -> ManagerBasedRlEnvCfg:
    """Put a planar task together.

    Args:
        robot: has the joints "root_x", "root_z" and "root_y", a root body "torso" and a sensor "com_velocity".
        motors: a pattern of the joints that motors drive; one action each, in [-1, 1].
        step_dt: s of an env step, `decimation` physics steps.
        distance: m from the camera to the robot.
    """
    terms = {
        "gravity": ObservationTermCfg(term=mdp.ProjectedGravity()),
        "joint_pos": ObservationTermCfg(term=mdp.JointPos(joints=("root_z", motors))),
        "joint_vel": ObservationTermCfg(term=mdp.JointVel()),
    }
    return ManagerBasedRlEnvCfg(
        decimation=decimation,
        scene=SceneCfg(robots={"robot": robot}, terrain=PlaneTerrain(), num_envs=2048),
        sim=SIM,
        observations={"actor": ObservationGroupCfg(terms=terms), "critic": ObservationGroupCfg(terms=terms)},
        actions={"torque": mdp.JointEffortAction(joints=motors)},
        events={
            "height": mdp.ResetJoints(joints="root_z", position_range=(0.02, 0.08)),
            "pitch": mdp.ResetJoints(joints="root_y", position_range=(-0.1, 0.1)),
            "legs": mdp.ResetJoints(joints=motors, position_range=(-0.1, 0.1), velocity_range=(-0.1, 0.1)),
        },
        rewards={"task": reward},
        terminations={"time_out": mdp.TimeOut(time_out=True)},
        metrics={"forward_speed": ForwardSpeed()},
        episode_length_s=STEPS_PER_EPISODE * step_dt,
        scale_rewards_by_dt=False,
        viewer=ViewerCfg(body="torso", distance=distance, elevation=-10.0, azimuth=90.0),
    )


OBJECTIVE: dict[str, Any] = {"entropy_coeff": 0.002, "clip_value": False}


def training(*, num_iterations: int = 500, objective: PPOCfg | None = None) -> TrainingCfg:
    """Return the training settings of a planar runner."""
    return TrainingCfg(
        num_envs=2048,
        objective=objective or PPOCfg(**OBJECTIVE),
        data=DatasetCfg(num_env_states_per_minibatch=16384, num_minibatches=4),
        modules=ModulesCfg(
            actor=ActorCfg(hidden_dims=(256, 128), init_std=0.6),
            critic=CriticCfg(hidden_dims=(256, 128)),
        ),
        trainer=TrainerCfg(num_iterations=num_iterations, eval_interval=50),
    )
