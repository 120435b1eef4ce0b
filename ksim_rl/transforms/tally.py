"""This kernel, also a torch operator, counts steps and rewards for trackers, per env: one launch counts and copies."""

import torch
from torch import Tensor

from ksim_rl.device.quick_launch import address, as_operator, launch_of

_quick_tally = launch_of("ksim_rl/transforms/tally.cuh")


def _tally(
    step_E: Tensor, total_E: Tensor, reward_E: Tensor | None, mask_E: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Count one env step and add its reward, or, given the rows that reset, let those begin at 0.

    `step_E` (int64) and `total_E` (float32) are changed in place, one number per env; copies of both are returned.
    `reward_E`, float32, is None for a reset, and `mask_E`, bool [E], for a step.
    """
    # The kernel reads rewards by address, one after the other.
    if reward_E is not None:
        reward_E = reward_E.contiguous()
    # Copies are outputs of the same launch: the kept tensors change in place with the next step.
    step_out_E = torch.empty_like(step_E)
    total_out_E = torch.empty_like(total_E)
    device = step_E.device
    num_rows = step_E.numel()
    # One thread does all on the CPU, in vector instructions.
    if device.type == "cpu":
        dim = (1, 1)
        rows = num_rows
    else:
        dim = (num_rows, 1)
        rows = 1
    read = address(mask_E), address(reward_E), total_E.data_ptr(), step_E.data_ptr()
    _quick_tally(device, dim, rows, *read, total_out_E.data_ptr(), step_out_E.data_ptr())
    return step_out_E, total_out_E


def _tally_in_torch(
    step_E: Tensor, total_E: Tensor, reward_E: Tensor | None, mask_E: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Do the work of the kernel in torch."""
    if mask_E is not None:
        step_E.masked_fill_(mask_E.view_as(step_E), 0)
        total_E.masked_fill_(mask_E.view_as(total_E), 0.0)
    else:
        assert reward_E is not None, "a step has rewards"
        step_E += 1
        total_E += reward_E.view_as(total_E)
    return step_E.clone(), total_E.clone()


tally = as_operator(
    "tally",
    _tally,
    lambda step_E, total_E, *_: (torch.empty_like(step_E), torch.empty_like(total_E)),
    mutates=("step_E", "total_E"),
    in_torch=_tally_in_torch,
)
