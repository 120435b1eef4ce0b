"""This module has the manipulation tasks with the settings that they are trained with: those of MuJoCo Playground.

They are translated from `config/manipulation_params.py` of its commit d5e6b47 and the defaults of Brax's PPO: policies
are normal before a tanh, with a standard deviation that depends on the state; neither values nor gradients are clipped.
"""

from functools import partial

from ksim_rl.data import DatasetCfg
from ksim_rl.envs.task import Task
from ksim_rl.modules import ActorCfg, CriticCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.suites.manipulation.leap import leap_cube_reorient
from ksim_rl.suites.manipulation.panda import panda_pick_cube
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg

_ppo = partial(
    PPOCfg,
    schedule="fixed",
    clip_epsilon=0.3,
    clip_value=False,
    max_grad_norm=None,
    critic_coeff=0.25,
    precision="auto",
)
_actor = partial(
    ActorCfg, activation="silu", distribution="tanh_gaussian", state_dependent_std=True, init_std=0.7
)
_critic = partial(CriticCfg, activation="silu")

PANDA = Task(
    name="panda_pick_cube",
    suite="manipulation",
    description="a Panda picks a cube up and carries it to a place in the air",
    cfg=panda_pick_cube,
    # 20 M env states, in minibatches of 512 pieces of 10 steps.
    training=TrainingCfg(
        num_envs=2048,
        objective=_ppo(gamma=0.97, num_epochs=8, learning_rate=1e-3, entropy_coeff=0.02),
        data=DatasetCfg(num_env_states_per_minibatch=5120, num_minibatches=32),
        modules=ModulesCfg(actor=_actor(hidden_dims=(32,) * 4), critic=_critic(hidden_dims=(256,) * 5)),
        trainer=TrainerCfg(num_iterations=122, eval_interval=50),
    ),
)
LEAP = Task(
    name="leap_cube_reorient",
    suite="manipulation",
    description="a LEAP hand turns a cube to one orientation after another",
    cfg=leap_cube_reorient,
    # 200 M env states, in minibatches of 256 pieces of 40 steps. The critic sees the actor's noisy readings too.
    training=TrainingCfg(
        num_envs=8192,
        objective=_ppo(gamma=0.99, num_epochs=4, learning_rate=3e-4, entropy_coeff=0.01),
        data=DatasetCfg(num_env_states_per_minibatch=10240, num_minibatches=32),
        modules=ModulesCfg(actor=_actor(), critic=_critic(in_keys=("actor", "critic"))),
        trainer=TrainerCfg(num_iterations=610, eval_interval=50),
    ),
)
TASKS = (PANDA, LEAP)
"""For the registry."""
