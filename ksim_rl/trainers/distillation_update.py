"""One iteration of distillation: labels, dataset, gradient steps, observation statistics; one CUDA graph on CUDA."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.data import DatasetBuffer, DatasetCfg, SequenceSampler
from ksim_rl.modules import MixedPolicy, burnt_in, memories, update_normalizers
from ksim_rl.objectives import (
    DistillationCfg,
    DistillationLoss,
    StepGuard,
    distribution_keys,
    make_optimizer,
    observation_keys,
    observation_keys_of,
    ppo_step,
)
from ksim_rl.physics.capture import Captured
from ksim_rl.trainers import state_tree
from ksim_rl.trainers.networks import build_actor
from ksim_rl.trainers.optimizer_state import load_optimizer_state, optimizer_state
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.trainers.teacher import MakePolicy, Teacher, load_teacher, restored_teacher

# Names of the logged means, by the names that `ppo_step` gives them.
LOGGED = {"loss_distillation": "loss/distillation", "kl": "update/kl", "grad_norm": "update/grad_norm"}


def make_distillation_update(
    cfg: RunCfg, env: EnvBase, resumed: Mapping[str, Any] | None, *, make_policy: MakePolicy
) -> "DistillationUpdate":
    """Build the distillation of a run.

    Args:
        resumed: the state that this run goes on from, which holds the teacher; None reads `objective.teacher`.
        make_policy: builds the policy of a run.
    """
    assert isinstance(cfg.objective, DistillationCfg)
    if not isinstance(cfg.data, DatasetCfg):
        raise ValueError(
            f"data is a {type(cfg.data).__name__}, and distillation needs a DatasetCfg: use data=on_policy"
        )
    student = build_actor(cfg, env)
    if resumed is None:
        teacher = load_teacher(Path(cfg.objective.teacher), env, cfg=cfg, make_policy=make_policy)
    else:
        teacher = restored_teacher(resumed["teacher"], env, cfg=cfg, make_policy=make_policy)
    return DistillationUpdate(
        cfg.objective,
        actor=student,
        teacher=teacher.policy,
        teacher_state=teacher,
        data=cfg.data,
        seed=cfg.seed,
        device=cfg.resolved_device(),
    )
