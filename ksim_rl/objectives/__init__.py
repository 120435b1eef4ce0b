"""This room estimates advantages from a rollout, and has the losses and gradient steps that improve the policy."""

from ksim_rl.objectives.adaptive_learning_rate import adapt_learning_rate_
from ksim_rl.objectives.algorithm_cfg import AlgorithmCfg
from ksim_rl.objectives.amp_cfg import AMPCfg
from ksim_rl.objectives.clip_ppo_loss import ClipPPOLoss
from ksim_rl.objectives.discriminator_loss import discriminator_loss, style_reward
from ksim_rl.objectives.distillation_cfg import DistillationCfg
from ksim_rl.objectives.distillation_loss import DistillationLoss, observation_keys_of
from ksim_rl.objectives.distributional import cross_entropy, mean_of, project_distribution
from ksim_rl.objectives.gae import GAE
from ksim_rl.objectives.gaussian_kl import kl_divergence
from ksim_rl.objectives.gradient_step import descend, load_optimizer_state_, make_adamw, make_optimizer
from ksim_rl.objectives.off_policy_cfg import OffPolicyCfg, SACCfg, TD3Cfg
from ksim_rl.objectives.off_policy_loss import OffPolicyLoss
from ksim_rl.objectives.policy_kl import distribution_keys, observation_keys
from ksim_rl.objectives.ppo_cfg import PPOCfg
from ksim_rl.objectives.ppo_step import (
    make_advantage,
    make_loss,
    make_symmetric,
    ppo_step,
)
from ksim_rl.objectives.precision import in_precision, with_precision_of
from ksim_rl.objectives.rollout_estimator import RolloutEstimator
from ksim_rl.objectives.sac_loss import SACLoss
from ksim_rl.objectives.step_guard import NonFiniteStepsError, StepGuard, clip_and_guard
from ksim_rl.objectives.symmetry import SymmetricAugmentation, mirror_loss
from ksim_rl.objectives.target_network import follow_, frozen, make_target
from ksim_rl.objectives.td3_loss import TD3Loss
from ksim_rl.objectives.td_lambda import TDLambda
from ksim_rl.objectives.vtrace import VTrace

__all__ = [
    "AMPCfg",
    "AlgorithmCfg",
    "GAE",
    "ClipPPOLoss",
    "DistillationCfg",
    "DistillationLoss",
    "NonFiniteStepsError",
    "OffPolicyCfg",
    "OffPolicyLoss",
    "PPOCfg",
    "RolloutEstimator",
    "SACCfg",
    "SACLoss",
    "StepGuard",
    "TD3Cfg",
    "TD3Loss",
    "SymmetricAugmentation",
    "TDLambda",
    "VTrace",
    "adapt_learning_rate_",
    "clip_and_guard",
    "cross_entropy",
    "descend",
    "discriminator_loss",
    "follow_",
    "frozen",
    "in_precision",
    "distribution_keys",
    "kl_divergence",
    "load_optimizer_state_",
    "make_adamw",
    "make_advantage",
    "make_loss",
    "make_optimizer",
    "make_target",
    "mean_of",
    "make_symmetric",
    "mirror_loss",
    "observation_keys",
    "observation_keys_of",
    "ppo_step",
    "project_distribution",
    "style_reward",
    "with_precision_of",
]
