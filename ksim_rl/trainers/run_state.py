"""This module saves and restores the state of torch's own random generators."""

from collections.abc import Mapping

import torch
from jaxtyping import UInt8
from torch import Tensor


def random_state(device: torch.device) -> dict[str, UInt8[Tensor, "?L"]]:
    """Return the state of the default generators of the host and of `device`."""
    state = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def load_random_state(state: Mapping[str, UInt8[Tensor, "?L"]], device: torch.device) -> None:
    """Continue the default generators; a run that moves to another kind of device keeps that one's present state."""
    torch.set_rng_state(state["cpu"])
    if device.type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)
