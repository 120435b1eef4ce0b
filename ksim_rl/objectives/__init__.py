"""Estimates advantages from a rollout, and has the losses and gradient steps that improve the policy."""

from ksim_rl.objectives.advantage_estimators import GAE, TDLambda, VTrace
from ksim_rl.objectives.algorithm_cfg import (
    AlgorithmCfg,
    AMPCfg,
    BCCfg,
    DistillationCfg,
    OffPolicyCfg,
    PPOCfg,
    SACCfg,
    TD3Cfg,
)
from ksim_rl.objectives.bc_loss import DEMONSTRATION, VALUE_TARGET, BCAndValueLoss, BCLoss
from ksim_rl.objectives.clip_ppo_loss import ClipPPOLoss
from ksim_rl.objectives.discriminator_loss import discriminator_loss, style_reward
from ksim_rl.objectives.distillation_loss import DistillationLoss
from ksim_rl.objectives.distributional import compare, mean_of, project_distribution
from ksim_rl.objectives.flat_adamw import FlatAdamW
from ksim_rl.objectives.gradient_step import (
    NonFiniteStepsError,
    StepGuard,
    adapt_learning_rate_,
    anneal_learning_rate_,
    clip_and_guard,
    go_back,
    make_optimizer,
)
from ksim_rl.objectives.off_policy_loss import OffPolicyLoss, SACLoss, TD3Loss, frozen
from ksim_rl.objectives.policy_kl import distribution_keys, kl_divergence, observation_keys
from ksim_rl.objectives.ppo_step import (
    in_precision,
    make_advantage,
    make_loss,
    make_symmetric,
    ppo_step,
    with_precision_of,
)
from ksim_rl.objectives.rollout_estimator import RolloutEstimator
from ksim_rl.objectives.shifted_pictures import ShiftedPictures
from ksim_rl.objectives.symmetry import SymmetricAugmentation, mirror_loss
