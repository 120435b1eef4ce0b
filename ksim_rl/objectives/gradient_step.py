"""Makes gradient steps without host syncs, skips those that are not finite, and adapts the learning rate."""

import functools
from collections.abc import Iterable, Mapping

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn

from ksim_rl import ranks
from ksim_rl.objectives.algorithm_cfg import OnPolicyCfg

# Without it each gradient would begin with a kernel that writes a one.
_ones = functools.cache(torch.ones)


class NonFiniteStepsError(RuntimeError):
    """Too many gradient steps in a row had a loss or a gradient that was not finite."""

    def __init__(self, in_a_row: int, *, limit: int, skipped: int) -> None:
        super().__init__(
            f"{in_a_row} gradient steps in a row had a loss or gradient that is not finite (limit {limit}, "
            f"{skipped} since the start); the parameters are as after the last good step. "
            "Lower the learning rate or max_grad_norm, or look for extreme rewards and observations"
        )


class StepGuard(nn.Module):
    """Counts gradient steps that were skipped on the device: since the start, and since the last one that was made."""

    skipped: Tensor
    skipped_in_a_row: Tensor

    def __init__(self, *, device: torch.device | str | None = None) -> None:
        super().__init__()
        self.register_buffer("skipped", torch.zeros((), dtype=torch.int64, device=device))
        self.register_buffer("skipped_in_a_row", torch.zeros((), dtype=torch.int64, device=device))

    @torch.no_grad()
    def count_(self, found_inf: Float32[Tensor, ""]) -> None:
        """Count one gradient step; `found_inf` is 1 if it was skipped, else 0. Makes no host sync."""
        skipped = found_inf.to(torch.int64)
        self.skipped.add_(skipped)
        # A step that was made multiplies by zero, which begins the count again without a branch.
        self.skipped_in_a_row.add_(skipped).mul_(skipped)


@torch.no_grad()
def clip_and_guard(
    parameters: Iterable[nn.Parameter],
    max_grad_norm: float | None,
    *,
    loss: Float[Tensor, ""] | None = None,
) -> tuple[Float32[Tensor, ""], Float32[Tensor, ""]]:
    """Scale the gradients down to a total norm of at most `max_grad_norm`, in place, and flag what is not finite.

    It is `torch.nn.utils.clip_grad_norm_` without host syncs. Returns the norm before clipping, and `found_inf`: 1 if
    the norm or the loss is not finite, else 0. A fused optimizer whose `found_inf` is 1 leaves parameters, moments and
    step count as they are.
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norm = nn.utils.get_total_norm(gradients)
    # One flag for the whole step: the fused optimizer reads it on the device.
    if loss is None:
        finite = norm.isfinite()
    else:
        finite = norm.isfinite() & loss.isfinite()
    if max_grad_norm is not None:
        # As in torch, 1e-6 keeps the factor finite where the norm is zero.
        torch._foreach_mul_(gradients, (max_grad_norm / (norm + 1e-6)).clamp_max(1.0))
    return norm, 1.0 - finite.to(torch.float32)


@torch.no_grad()
def adapt_learning_rate_(
    lr: Float32[Tensor, ""],
    kl: Float[Tensor, ""],
    *,
    desired_kl: float,
    factor: float = 1.5,
    lr_min: float | Float32[Tensor, ""] = 1e-5,
    lr_max: float | Float32[Tensor, ""] = 1e-2,
) -> Float32[Tensor, ""]:
    """Divide `lr` by `factor` if `kl`, in nats, exceeds twice the desired one, multiply it if below half, in place.

    The rule of rsl_rl, without host syncs. A divergence of exactly zero (the policy has not moved yet), or one that is
    NaN, changes nothing.
    """
    # Both candidates are computed, and one is chosen on the device: a branch would wait for the host.
    slower = (lr / factor).clamp_min(lr_min)
    faster = (lr * factor).clamp_max(lr_max)
    # Comparisons with NaN are False.
    too_far = kl > 2.0 * desired_kl
    too_near = (kl < 0.5 * desired_kl) & (kl > 0.0)
    return lr.copy_(torch.where(too_far, slower, torch.where(too_near, faster, lr)))


def rate_bounds(cfg: OnPolicyCfg, optimizer: torch.optim.Optimizer) -> Float32[Tensor, "2"]:
    """Return the least and the greatest learning rate, on the device, where `anneal_learning_rate_` changes them."""
    group = optimizer.param_groups[0]
    # Kept in the group, as a captured graph needs the same address in each run.
    if "lr_bounds" not in group:
        bounds = cfg.learning_rate_min, cfg.learning_rate_max
        group["lr_bounds"] = torch.tensor(bounds, dtype=torch.float32, device=group["lr"].device)
    return group["lr_bounds"]


@torch.no_grad()
def anneal_learning_rate_(
    cfg: OnPolicyCfg, optimizer: torch.optim.Optimizer, *, done: float
) -> None:
    """Bound the learning rate for the rest of a run after a share `done`, in [0, 1], if `cfg` anneals it."""
    if not 0.0 <= done <= 1.0:
        raise ValueError(f"done={done!r}: expected the share of the run that is done, in [0, 1]")
    if cfg.anneal_learning_rate:
        adapts = cfg.schedule == "adaptive"
        # The adaptive rate keeps its freedom below a falling ceiling; a fixed one follows the line itself.
        ceiling = (cfg.learning_rate_max if adapts else cfg.learning_rate) * (1.0 - done)
        low, high = rate_bounds(cfg, optimizer)
        low.fill_(min(cfg.learning_rate_min, ceiling) if adapts else ceiling)
        optimizer.param_groups[0]["lr"].clamp_(low, high.fill_(ceiling))


def make_optimizer(cfg: OnPolicyCfg, *modules: nn.Module) -> torch.optim.Adam:
    """Build one fused Adam over the parameters of `modules`, each once, capturable on CUDA.

    `optimizer.param_groups[0]["lr"]` is a float32 tensor [] on the device that changes in place.
    """
    # A trunk that actor and critic share must be stepped once.
    parameters = list(
        dict.fromkeys(parameter for module in modules for parameter in module.parameters())
    )
    device = parameters[0].device
    return torch.optim.Adam(
        [{"params": parameters, "initial_lr": cfg.learning_rate}],
        # A tensor, since a number would be baked into a captured graph.
        lr=torch.tensor(cfg.learning_rate, dtype=torch.float32, device=device),
        betas=cfg.betas,
        eps=cfg.adam_eps,
        weight_decay=cfg.weight_decay,
        fused=True,
        capturable=device.type == "cuda",
    )


def go_back(
    losses: Mapping[str, Float[Tensor, ""]],
    optimizers: Mapping[str, torch.optim.Optimizer],
    *,
    mask: Bool[Tensor, "*rows"] | None = None,
    beside: Iterable[Float[Tensor, ""]] = (),
) -> None:
    """Compute the gradients of each loss, means over all ranks; losses and the tensors `beside` become means in place.

    A loss is a mean over the rows that `mask` marks, or over all: each rank weighs as much as it has of these. No loss
    may reach a parameter of another's optimizer.
    """
    # None instead of zeros: parameters that no loss reaches then have no gradient to average or to clip.
    for name in losses:
        optimizers[name].zero_grad(set_to_none=True)
    ends = list(losses.values())
    # One pass for all losses: none reaches the parameters of another, so their gradients do not mix.
    torch.autograd.backward(ends, [_ones((), dtype=end.dtype, device=end.device) for end in ends])
    if ranks.size() > 1:
        learnt = [parameter.grad for name in losses for parameter in _parameters(optimizers[name])]
        gradients = [gradient for gradient in learnt if gradient is not None]
        values = [value.detach() for value in (*losses.values(), *beside)]
        # The share of rows that take part on this rank: ranks with more of them weigh more.
        if mask is None:
            weight = torch.ones_like(values[0])
        else:
            weight = mask.to(torch.float32).mean()
        ranks.mean_([*gradients, *values], weight=weight)


def step(
    optimizer: torch.optim.Optimizer, loss: Float[Tensor, ""], *, max_grad_norm: float | None
) -> tuple[Float32[Tensor, ""], Float32[Tensor, ""]]:
    """Make the step of a fused optimizer whose gradients are there, unless the loss or one of these is not finite.

    It can be captured in a CUDA graph. Returned are the norm before clipping, and 1 if the step was skipped, else 0.
    """
    grad_norm, found_inf = clip_and_guard(_parameters(optimizer), max_grad_norm, loss=loss.detach())
    # Fused optimizers read these two, which torch's GradScaler sets as well, and skip the step on the device.
    optimizer.grad_scale = None  # type: ignore[attr-defined]
    optimizer.found_inf = found_inf  # type: ignore[attr-defined]
    optimizer.step()
    return grad_norm, found_inf


def _parameters(optimizer: torch.optim.Optimizer) -> list[nn.Parameter]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
