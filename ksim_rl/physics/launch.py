"""This module launches Warp kernels whose parameters have the names of what they take."""

import inspect
from collections.abc import Mapping
from typing import Any

import mujoco_warp as mjw
import warp as wp


def launch_by_name(
    kernel: wp.Kernel, dim: int | tuple[int, ...], *owners: Mapping[str, Any] | mjw.Model | mjw.Data
) -> None:
    """Launch a kernel without gradients; each argument is that of its name in the first owner that has it."""
    fields = [owner if isinstance(owner, Mapping) else vars(owner) for owner in owners]
    names = inspect.signature(kernel.func).parameters
    arguments = [next(owned[name] for owned in fields if name in owned) for name in names]
    wp.launch(kernel, dim=dim, inputs=arguments)
