"""Objectives: what is estimated from a rollout, and the losses and gradient steps that improve the policy."""

from ksim_rl.objectives.adaptive_learning_rate import adapt_learning_rate_
from ksim_rl.objectives.clip_ppo_loss import ClipPPOLoss
from ksim_rl.objectives.gae import GAE
from ksim_rl.objectives.gaussian_kl import kl_divergence
from ksim_rl.objectives.ppo_cfg import PPOCfg
from ksim_rl.objectives.ppo_step import (
    load_optimizer_state_,
    make_advantage,
    make_loss,
    make_optimizer,
    make_symmetric,
    ppo_step,
)
from ksim_rl.objectives.rollout_estimator import RolloutEstimator
from ksim_rl.objectives.step_guard import NonFiniteStepsError, StepGuard, clip_and_guard
from ksim_rl.objectives.symmetry import SymmetricAugmentation, mirror_loss
from ksim_rl.objectives.td_lambda import TDLambda
from ksim_rl.objectives.vtrace import VTrace

__all__ = [
    "GAE",
    "ClipPPOLoss",
    "NonFiniteStepsError",
    "PPOCfg",
    "RolloutEstimator",
    "StepGuard",
    "SymmetricAugmentation",
    "TDLambda",
    "VTrace",
    "adapt_learning_rate_",
    "clip_and_guard",
    "kl_divergence",
    "load_optimizer_state_",
    "make_advantage",
    "make_loss",
    "make_optimizer",
    "make_symmetric",
    "mirror_loss",
    "ppo_step",
]
