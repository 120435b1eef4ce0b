"""A pendulum is swung up by a torque that cannot lift it, as in dm_control's suite (Tassa et al., 2018).

Their reward is 1 within 8 degrees of upright and 0 elsewhere; ours rates the way there too.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.algorithms import fast_td3
from ksim_rl.algorithms.fast_td3 import FastTD3Cfg
from ksim_rl.data import DatasetCfg, ReplayCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import ObservationTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tracking import tolerance
from ksim_rl.scene.robots.control_models import Pendulum
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import small_networks
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

UPRIGHT = math.cos(math.radians(8.0))


@dataclass(frozen=True, kw_only=True)
class PendulumAngle(ObservationTerm):
    """Cosine and sine of the angle from upright, [E, 2]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 2"]:
        return torch.cat((torch.cos(view.joint_pos_EL), torch.sin(view.joint_pos_EL)), dim=-1)


@dataclass(frozen=True, kw_only=True)
class PendulumReward(RewardTerm):
    """up * (1 + 4 slow) / 5, in [0, 1]; position and velocity stage.

    "up" grows linearly with the cosine, to 1 at 8 degrees from upright; "slow" is 1 at rest and 0.1 at 5 rad/s, so that
    turning round and round gives less than half of what swinging does.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        cosine_E, speed_E = torch.cos(view.joint_pos_EL[:, 0]), view.joint_vel_EL[:, 0]
        up_E = tolerance(cosine_E, low=UPRIGHT, margin=1.0 + UPRIGHT, value_at_margin=0.0, shape="linear")
        return up_E * (1.0 + 4.0 * tolerance(speed_E, low=0.0, high=0.0, margin=5.0)) / 5.0


def pendulum_swingup() -> ManagerBasedRlEnvCfg:
    """Return the config of swinging the pendulum up, from any angle, and holding it there."""
    terms = {
        "angle": ObservationTermCfg(term=PendulumAngle()),
        "velocity": ObservationTermCfg(term=mdp.JointVel()),
    }
    return ManagerBasedRlEnvCfg(
        decimation=2,
        scene=SceneCfg(robots={"pendulum": Pendulum()}, num_envs=1024),
        observations={"actor": ObservationGroupCfg(terms=terms), "critic": ObservationGroupCfg(terms=terms)},
        actions={"torque": mdp.JointEffortAction()},
        events={"reset": mdp.ResetJoints(position_range=(-math.pi, math.pi))},
        rewards={"swing_up": PendulumReward()},
        terminations={"time_out": mdp.TimeOut(time_out=True)},
        episode_length_s=20.0,
        scale_rewards_by_dt=False,
        viewer=ViewerCfg(lookat=(0.0, 0.0, 0.8), distance=2.5, elevation=-10.0, azimuth=90.0),
    )


SWINGUP = Task(
    name="pendulum_swingup",
    description="swing a pendulum up with little torque and hold it there",
    cfg=pendulum_swingup,
    training=small_networks.training(
        num_envs=256,
        data=DatasetCfg(num_env_states_per_minibatch=2048, num_minibatches=8),
        num_iterations=150,
        learning_rate=1e-3,
        num_epochs=8,
        entropy_coeff=0.0,
    ),
    # Few envs, small networks and small minibatches, for a CPU.
    other_trainings=(
        TrainingCfg(
            num_envs=16,
            objective=FastTD3Cfg(
                gamma=0.98,
                tau=0.02,
                critic_learning_rate=1e-3,
                actor_learning_rate=1e-3,
                exploration_noise_min=0.05,
                exploration_noise_max=0.5,
                target_noise=0.05,
                weight_decay=0.0,
            ),
            data=ReplayCfg(
                num_env_states_per_minibatch=256,
                num_minibatches=32,
                num_steps=8,
                capacity=4000,
                learning_starts=64,
            ),
            modules=ModulesCfg(
                actor=replace(fast_td3.ACTOR, hidden_dims=(64, 64)),
                # Rewards lie in [0, 1], returns in [0, 50].
                critic=replace(fast_td3.CRITIC, hidden_dims=(128, 128), v_min=-5.0, v_max=55.0),
            ),
            trainer=TrainerCfg(num_iterations=400, eval_interval=50),
        ),
    ),
    # Upright and at rest from 3 s on, on average over all starts (850 of 1000 steps), with nothing before that.
    solved_at=850.0,
)
