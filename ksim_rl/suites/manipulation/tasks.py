"""The manipulation tasks with the settings that they are trained with.

MuJoCo Playground's are in `config/manipulation_params.py` of its commit d5e6b47. With these a Panda lifts its first
cubes later, and a hand turns its cube about half as often after the same seconds; see docs/suites.md.
"""

from functools import partial

from ksim_rl.data import DatasetCfg
from ksim_rl.envs.task import Task
from ksim_rl.modules import ActorCfg, CriticCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.suites.manipulation.drawer import DRAWER
from ksim_rl.suites.manipulation.leap import leap_cube_reorient
from ksim_rl.suites.manipulation.panda import panda_pick_cube
from ksim_rl.suites.manipulation.panda_pixels import PANDA_PIXELS
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg

_ppo = partial(PPOCfg, clip_value=False, critic_coeff=0.25)
_squashed = partial(ActorCfg, distribution="tanh_gaussian", state_dependent_std=True, init_std=0.7)

PANDA = Task(
    name="panda_pick_cube",
    suite="manipulation",
    description="a Panda picks a cube up and carries it to a place in the air",
    cfg=panda_pick_cube,
    # First cubes are lifted after 9 to 13 million env states, nearly all of them 5 million later.
    training=TrainingCfg(
        num_envs=2048,
        objective=_ppo(
            gamma=0.97,
            num_epochs=8,
            learning_rate=7e-4,
            schedule="fixed",
            entropy_coeff=0.03,
            clip_epsilon=0.3,
        ),
        data=DatasetCfg(num_env_states_per_minibatch=10240, num_minibatches=16),
        modules=ModulesCfg(
            actor=_squashed(hidden_dims=(128, 128), activation="silu"),
            critic=CriticCfg(hidden_dims=(256, 256), activation="silu"),
        ),
        trainer=TrainerCfg(num_iterations=183, eval_interval=50),
    ),
)
LEAP = Task(
    name="leap_cube_reorient",
    suite="manipulation",
    description="a LEAP hand turns a cube to one orientation after another",
    cfg=leap_cube_reorient,
    # The critic sees the actor's noisy readings too.
    training=TrainingCfg(
        num_envs=16384,
        objective=_ppo(learning_rate=3e-4, desired_kl=0.016, entropy_coeff=0.002, precision="auto"),
        data=DatasetCfg(num_env_states_per_minibatch=65536, num_minibatches=4),
        modules=ModulesCfg(
            actor=ActorCfg(init_std=0.5), critic=CriticCfg(in_keys=("actor", "critic"))
        ),
        trainer=TrainerCfg(num_iterations=1831, eval_interval=100),
    ),
)
TASKS = (PANDA, PANDA_PIXELS, LEAP, DRAWER)
"""For the registry."""
