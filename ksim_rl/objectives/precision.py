"""A loss whose matrix products take fewer bits."""

import torch
from tensordict import TensorDictBase

from ksim_rl.objectives.symmetry import Loss


def in_precision(loss: Loss, precision: str, *, device: torch.device | str) -> Loss:
    """Return `loss` with its products in `precision`; the loss itself for "float32".

    With "bfloat16" torch's autocast rounds what layers multiply to 8 significant bits. Parameters, their gradients,
    sums and the losses stay float32.
    """
    if precision == "float32":
        return loss
    dtype, kind = getattr(torch, precision), torch.device(device).type

    def rounded(minibatch_B: TensorDictBase) -> TensorDictBase:
        with torch.autocast(kind, dtype):
            return loss(minibatch_B)

    return rounded
