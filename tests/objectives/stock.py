"""Our clipped PPO loss beside TorchRL's."""

import torch
from torchrl import objectives

from ksim_rl.objectives import ClipPPOLoss

LOSSES = ("loss_objective", "loss_critic", "loss_entropy")


def both(actor, critic, **options):
    return [cls(actor, critic, **options) for cls in (ClipPPOLoss, objectives.ClipPPOLoss)]


def same(ours, stock, data):
    """Compare losses and gradients."""
    outs, gradients = [], []
    for loss in (ours, stock):
        out = loss(data.clone())
        total = sum(out[name].sum() for name in LOSSES if name in out)
        parameters = [parameter for parameter in loss.parameters() if parameter.requires_grad]
        gradients.append(torch.autograd.grad(total, parameters, allow_unused=True))
        outs.append(out)
    for name in LOSSES:
        assert (name in outs[0]) == (name in outs[1])
        if name in outs[0]:
            torch.testing.assert_close(outs[0][name], outs[1][name], atol=1e-6, rtol=1e-6)
    for one, other in zip(*gradients, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)
    return outs
