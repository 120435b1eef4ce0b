"""Distillation (DAgger, Ross et al., arXiv 1011.0686) lets a student act as a teacher does, where the student goes."""

from ksim_rl.algorithms.distillation.update import make_distillation_update
from ksim_rl.algorithms.ppo import ON_POLICY
from ksim_rl.objectives import DistillationCfg

DISTILLATION = ON_POLICY(name="distillation", cfg=DistillationCfg, update=make_distillation_update)
