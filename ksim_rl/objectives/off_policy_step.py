"""One gradient step of an off-policy objective, and the optimizers that it needs."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from ksim_rl.objectives.off_policy_cfg import OffPolicyCfg
from ksim_rl.objectives.step_guard import clip_and_guard


def make_adamw(
    cfg: OffPolicyCfg, parameters: Iterable[nn.Parameter], *, learning_rate: float, weight_decay: float
) -> torch.optim.AdamW:
    """Build one fused AdamW (Loshchilov and Hutter, arXiv 1711.05101) with the learning rate on the device.

    `optimizer.param_groups[0]["lr"]` is a float32 tensor []. On CUDA the optimizer is capturable.
    """
    parameters = list(parameters)
    device = parameters[0].device
    return torch.optim.AdamW(
        parameters,
        lr=torch.tensor(learning_rate, dtype=torch.float32, device=device),
        betas=cfg.betas,
        eps=cfg.adam_eps,
        weight_decay=weight_decay,
        fused=True,
        capturable=device.type == "cuda",
    )


def descend(
    loss: Tensor, optimizer: torch.optim.Optimizer, *, max_grad_norm: float | None
) -> tuple[Tensor, Tensor]:
    """Make one gradient step on the parameters of a fused optimizer, unless loss or gradient are not finite.

    Makes no host sync and can be captured in a CUDA graph.

    Returns:
        The norm of the gradient before clipping, and 1 if the step was skipped, else 0, each a tensor [].
    """
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    grad_norm, found_inf = clip_and_guard(parameters, max_grad_norm, loss=loss.detach())
    # Fused optimizers read these two, which torch's GradScaler sets as well, and skip the step on the device.
    optimizer.grad_scale, optimizer.found_inf = None, found_inf  # type: ignore[attr-defined]
    optimizer.step()
    return grad_norm, found_inf
