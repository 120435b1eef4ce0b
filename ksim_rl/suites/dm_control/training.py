"""The settings that the tasks of the DeepMind Control Suite are trained with: one set by algorithm."""

import dataclasses
import math

from ksim_rl.algorithms import fast_sac
from ksim_rl.algorithms.off_policy import MANY_ENVS
from ksim_rl.data import DatasetCfg
from ksim_rl.modules import ActorCfg, CriticCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg

NUM_ENVS = 2048
# Env states that MuJoCo Playground gives PPO.
PPO_STATES = 60e6


def ppo(*, gamma: float = 0.995, env_states: float = PPO_STATES) -> TrainingCfg:
    """Return the settings of PPO: 64 steps of each env and 128 gradient steps in turn.

    Rewards lie in [0, 1] per step, so that values reach 1 / (1 - gamma) and gradients hundreds: clipping the change
    of values to 0.2, or gradients to 1, would stop the critic from learning. In bfloat16 WalkerRun came to 267 after
    20 M env states, in float32 to 676. Many actions have a large divergence in sum, which would hold the adaptive
    learning rate at its usual floor of 1e-5. Without least deviations, exploration ends where rewards are rare.
    """
    return TrainingCfg(
        num_envs=NUM_ENVS,
        objective=PPOCfg(
            gamma=gamma,
            num_epochs=8,
            clip_value=False,
            desired_kl=0.02,
            min_advantage_std=0.02,
            entropy_coeff=0.001,
            learning_rate_min=1e-4,
            learning_rate_max=1e-3,
            anneal_learning_rate=True,
            max_grad_norm=100.0,
        ),
        data=DatasetCfg(num_env_states_per_minibatch=8192, num_minibatches=16),
        modules=ModulesCfg(
            actor=ActorCfg(hidden_dims=(256, 256, 128), init_std=0.7, min_std=0.2),
            critic=CriticCfg(hidden_dims=(256, 256, 128)),
        ),
        trainer=TrainerCfg(
            num_iterations=math.ceil(env_states / (8192 * 16)),
            eval_interval=50,
            stop_when_solved=False,
        ),
    )


def fast_sac_training(*, env_states: float) -> TrainingCfg:
    """Return the settings of FastSAC: 4 steps of each env and 16 gradient steps in turn.

    Returns lie in [0, 100]. Values of a new critic are in the middle of its range: with [-5, 105] they began near 50,
    and HumanoidWalk had a return of 12 after 4 M env states; with [-100, 100] it has 650 after 5 M.
    """
    num_envs = 1024
    data = dataclasses.replace(
        MANY_ENVS,
        num_env_states_per_minibatch=4096,
        num_minibatches=16,
        num_steps=4,
        save_replay=False,
    )
    return TrainingCfg(
        num_envs=num_envs,
        objective=fast_sac.FastSACCfg(
            gamma=0.99, target_entropy_per_action=-0.5, policy_delay=2, autocast=True, compile=True
        ),
        data=data,
        modules=ModulesCfg(
            actor=fast_sac.ACTOR,
            critic=dataclasses.replace(fast_sac.CRITIC, v_min=-100.0, v_max=100.0),
        ),
        trainer=TrainerCfg(
            num_iterations=math.ceil(env_states / (num_envs * data.num_steps)),
            eval_interval=500,
            log_interval=20,
            checkpoint_interval=500,
            stop_when_solved=False,
        ),
    )
