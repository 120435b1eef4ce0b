"""Makes one gradient step of PPO, and builds its parts from one config."""

import dataclasses
from collections.abc import Mapping
from functools import reduce
from operator import add
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from ksim_rl.objectives.advantage_estimators import GAE, TDLambda, VTrace
from ksim_rl.objectives.algorithm_cfg import OnPolicyCfg, PPOCfg
from ksim_rl.objectives.clip_ppo_loss import ClipPPOLoss
from ksim_rl.objectives.gradient_step import (
    StepGuard,
    adapt_learning_rate_,
    go_back,
    rate_bounds,
    step,
)
from ksim_rl.objectives.masked import MASK_KEY
from ksim_rl.objectives.rollout_estimator import RolloutEstimator
from ksim_rl.objectives.symmetry import Loss, SymmetricAugmentation, mirror_loss
from ksim_rl.transforms import MirrorMap


def with_precision_of(cfg: PPOCfg, device: torch.device | str) -> PPOCfg:
    """Return `cfg` with the precision that "auto" stands for on a device: "bfloat16" on CUDA, else "float32"."""
    if torch.device(device).type == "cuda":
        resolved = "bfloat16"
    else:
        resolved = "float32"
    if cfg.precision == "auto":
        return dataclasses.replace(cfg, precision=resolved)
    return cfg


def in_precision(loss: Loss, precision: str, *, device: torch.device | str) -> Loss:
    """Return `loss` with its products in `precision`; the loss itself for "float32".

    With "bfloat16" torch's autocast rounds the factors of layers to 8 significant bits, and nothing else.
    """
    if precision == "float32":
        return loss
    # Autocast is entered around the loss only: the backward pass takes the dtypes of the forward pass.
    dtype = getattr(torch, precision)
    kind = torch.device(device).type

    def rounded(minibatch_B: TensorDictBase) -> TensorDictBase:
        with torch.autocast(kind, dtype):
            return loss(minibatch_B)

    return rounded


def make_advantage(
    cfg: PPOCfg, actor: ProbabilisticTensorDictSequential, critic: TensorDictModule
) -> RolloutEstimator:
    """Build the advantage estimator of `cfg`. It uses the modules as they are."""
    # The estimator standardizes over the whole dataset; per minibatch the loss does it itself.
    options: dict[str, Any] = {
        "gamma": cfg.gamma,
        "lmbda": cfg.lmbda,
        "critic": critic,
        "normalize_advantage": cfg.normalize_advantage == "dataset",
        "min_advantage_std": cfg.min_advantage_std,
    }
    if cfg.advantage == "vtrace":
        return VTrace(actor=actor, rho_thresh=cfg.rho_thresh, c_thresh=cfg.c_thresh, **options)
    return {"gae": GAE, "td_lambda": TDLambda}[cfg.advantage](
        value_lmbda=cfg.value_lmbda, **options
    )


def make_loss(
    cfg: PPOCfg, actor: ProbabilisticTensorDictSequential, critic: TensorDictModule
) -> ClipPPOLoss:
    """Build the loss of `cfg`. It uses the modules themselves: a change in them is a change in the loss."""
    return ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=cfg.clip_epsilon,
        clip_value=cfg.clip_value,
        entropy_coeff=cfg.entropy_coeff,
        critic_coeff=cfg.critic_coeff,
        loss_critic_type="l2",
        normalize_advantage=cfg.normalize_advantage == "minibatch",
        functional=False,
        log_ratio_statistics=False,
    )


def make_symmetric(
    cfg: PPOCfg,
    loss: ClipPPOLoss,
    maps: Mapping[NestedKey, MirrorMap] | None,
    *,
    device: torch.device | str | None = None,
) -> Loss:
    """Return `loss` with the symmetry that `cfg` asks for.

    Raises ValueError where `maps` lacks the mirror image of "action" or of an input of the networks of `loss`.
    """
    if cfg.symmetry == "none":
        return loss
    actor: Any = loss.actor_network
    # All that either network reads must have an image, or the mirrored half would be half mirrored.
    read = [*actor.in_keys, *loss.critic_network.in_keys]
    mirror = SymmetricAugmentation(maps, read=read, symmetry=cfg.symmetry, device=device)
    if cfg.symmetry == "augment":
        return lambda minibatch_B: loss(mirror(minibatch_B))

    def with_mirror_loss(minibatch_B: TensorDictBase) -> TensorDictBase:
        # The mirror loss gets its coefficient here; PPO's own losses come with theirs.
        losses = loss(minibatch_B)
        return losses.set(
            "loss_mirror", cfg.symmetry_coeff * mirror_loss(actor, minibatch_B, mirror)
        )

    return with_mirror_loss


def ppo_step(
    loss: Loss,
    optimizer: torch.optim.Optimizer,
    minibatch_B: TensorDictBase,
    *,
    cfg: OnPolicyCfg,
    guard: StepGuard | None = None,
) -> dict[str, Float[Tensor, ""]]:
    """Make one gradient step on a minibatch. Makes no host sync and can be captured in a CUDA graph.

    With the adaptive schedule the learning rate is changed before the step, as in rsl_rl, by the `kl` that the loss
    returns with its `loss_*`. A step whose loss or gradient is not finite changes no parameter, moment or step count
    of the optimizer, which must be fused, with a tensor as learning rate. Returned are the tensors that the loss
    returns, detached, and `loss`, `grad_norm` (before clipping), `learning_rate` (of this step), `skipped` (0 or 1).
    """
    losses = loss(minibatch_B)
    # All terms named `loss_*` are to be minimized; the others are logged only.
    total = reduce(add, [value for name, value in losses.items() if name.startswith("loss_")])
    learning_rate = optimizer.param_groups[0]["lr"]
    measured = {name: value.detach() for name, value in losses.items() if isinstance(value, Tensor)}
    mask = minibatch_B.get(MASK_KEY, None)
    # From here on losses and measured values are means over all ranks, so that all ranks decide alike.
    go_back({"loss": total}, {"loss": optimizer}, mask=mask, beside=measured.values())
    # Before the step, as in rsl_rl: the divergence is of the policy as it is now.
    if cfg.schedule == "adaptive":
        low = cfg.learning_rate_min
        high = cfg.learning_rate_max
        if cfg.anneal_learning_rate:
            low, high = rate_bounds(cfg, optimizer)
        adapt_learning_rate_(
            learning_rate, measured["kl"], desired_kl=cfg.desired_kl, lr_min=low, lr_max=high
        )
    grad_norm, found_inf = step(optimizer, total, max_grad_norm=cfg.max_grad_norm)
    if guard is not None:
        guard.count_(found_inf)
    return {
        # Without the entropies of several actions, which are in a TensorDict next to their sum.
        **measured,
        "loss": total.detach(),
        "grad_norm": grad_norm,
        # A copy: the tensor itself changes in place with the next step.
        "learning_rate": learning_rate.clone(),
        "skipped": found_inf,
    }
