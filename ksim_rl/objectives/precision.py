"""This module sets in how many bits a loss multiplies matrices."""

import dataclasses

import torch
from tensordict import TensorDictBase

from ksim_rl.objectives.ppo_cfg import PPOCfg
from ksim_rl.objectives.symmetry import Loss


def with_precision_of(cfg: PPOCfg, device: torch.device | str) -> PPOCfg:
    """Return `cfg` with the precision that "auto" stands for on a device: "bfloat16" on CUDA, else "float32"."""
    if cfg.precision != "auto":
        return cfg
    return dataclasses.replace(
        cfg, precision="bfloat16" if torch.device(device).type == "cuda" else "float32"
    )


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
