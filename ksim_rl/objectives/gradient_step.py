"""This module makes single gradient steps without host syncs, and the fused optimizers that they need."""

import copy
from collections.abc import Iterable
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from ksim_rl.objectives.algorithm_cfg import GradientCfg, OnPolicyCfg
from ksim_rl.objectives.step_guard import clip_and_guard

AnyAdam = TypeVar("AnyAdam", torch.optim.Adam, torch.optim.AdamW)


def make_optimizer(cfg: OnPolicyCfg, *modules: nn.Module) -> torch.optim.Adam:
    """Build one fused Adam over the parameters of `modules`, each once, with the learning rate on the device.

    `optimizer.param_groups[0]["lr"]` is a float32 tensor [] that changes in place. On CUDA the optimizer is
    capturable.
    """
    parameters = dict.fromkeys(parameter for module in modules for parameter in module.parameters())
    return _fused(torch.optim.Adam, cfg, parameters, cfg.learning_rate, cfg.weight_decay)


def make_adamw(
    cfg: GradientCfg, parameters: Iterable[nn.Parameter], *, learning_rate: float, weight_decay: float
) -> torch.optim.AdamW:
    """Build one fused AdamW (Loshchilov and Hutter, arXiv 1711.05101); else as `make_optimizer`."""
    return _fused(torch.optim.AdamW, cfg, parameters, learning_rate, weight_decay)


def _fused(
    kind: type[AnyAdam],
    cfg: GradientCfg,
    parameters: Iterable[nn.Parameter],
    rate: float,
    weight_decay: float,
) -> AnyAdam:
    parameters = list(parameters)
    device = parameters[0].device
    return kind(
        parameters,
        lr=torch.tensor(rate, dtype=torch.float32, device=device),
        betas=cfg.betas,
        eps=cfg.adam_eps,
        weight_decay=weight_decay,
        fused=True,
        capturable=device.type == "cuda",
    )


def load_optimizer_state_(optimizer: torch.optim.Optimizer, state_dict: dict[str, Any]) -> None:
    """Load a state dict; the learning rate stays a tensor on the parameters' device, at its address."""
    learning_rates = [group["lr"] for group in optimizer.param_groups]
    # torch takes over the tensors of the state dict themselves, and steps would change them in place.
    optimizer.load_state_dict(copy.deepcopy(state_dict))
    for group, learning_rate in zip(optimizer.param_groups, learning_rates, strict=True):
        if isinstance(learning_rate, Tensor):
            group["lr"] = learning_rate.copy_(torch.as_tensor(group["lr"]))


def descend(
    loss: Float[Tensor, ""], optimizer: torch.optim.Optimizer, *, max_grad_norm: float | None
) -> tuple[Float32[Tensor, ""], Float32[Tensor, ""]]:
    """Make one gradient step on the parameters of a fused optimizer, unless loss or gradient are not finite.

    Makes no host sync and can be captured in a CUDA graph. A skipped step changes no parameter, moment or step count.

    Returns:
        The norm of the gradient before clipping, and 1 if the step was skipped, else 0.
    """
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    grad_norm, found_inf = clip_and_guard(parameters, max_grad_norm, loss=loss.detach())
    # Fused optimizers read these two, which torch's GradScaler sets as well, and skip the step on the device.
    optimizer.grad_scale, optimizer.found_inf = None, found_inf  # type: ignore[attr-defined]
    optimizer.step()
    return grad_norm, found_inf
