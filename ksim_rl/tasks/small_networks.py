"""This module holds how tasks with one or two joints are trained."""

from typing import Any

from ksim_rl.data import DatasetCfg
from ksim_rl.modules import ActorCfg, CriticCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg

MODULES = ModulesCfg(actor=ActorCfg(hidden_dims=(64, 64)), critic=CriticCfg(hidden_dims=(64, 64)))


def training(
    *, num_envs: int, data: DatasetCfg, num_iterations: int, eval_interval: int = 10, **objective: Any
) -> TrainingCfg:
    """Return the settings of such a task: small networks, and PPO with `objective`, the fields of `PPOCfg`."""
    return TrainingCfg(
        num_envs=num_envs,
        # Values reach 100 here: clipping their change to 0.2 would stop the critic from learning.
        objective=PPOCfg(clip_value=False, schedule="fixed", **objective),
        data=data,
        modules=MODULES,
        trainer=TrainerCfg(num_iterations=num_iterations, eval_interval=eval_interval),
    )
