"""Distillation (DAgger, Ross et al., arXiv 1011.0686) lets a student act as a teacher does, where the student goes."""

from ksim_rl.algorithms import ppo
from ksim_rl.algorithms.distillation.update import make_distillation_update
from ksim_rl.objectives import DistillationCfg
from ksim_rl.trainers.algorithm import Algorithm

DISTILLATION = Algorithm(
    name="distillation",
    cfg=DistillationCfg,
    update=make_distillation_update,
    policy=ppo.make_ppo_policy,
    data=ppo.DATA,
    on_ranks=True,
)
