"""Keeps starts of episodes that are drawn on the host, once for each model in a process, and once on each device."""

import hashlib
from collections.abc import Callable
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.physics import World
from ksim_rl.physics.model_checks import model_bytes

# The banks of this process, so that training and evaluations draw them once, and their copies on devices.
_DRAWN: dict[tuple[str, bytes], np.ndarray] = {}
_BANKS: WeakKeyDictionary[World, dict[str, Tensor]] = WeakKeyDictionary()


def bank_of(
    view: EnvView, rule: str, draw: Callable[[], Float[np.ndarray, "N L"]]
) -> Float[Tensor, "N L"]:
    """Return the starts that `draw` returns, float32, on the view's device; another model or `rule` has its own."""
    known = _BANKS.setdefault(view.world, {})
    if rule not in known:
        # The model's bytes: a bank depends on all that physics sees.
        key = rule, hashlib.sha256(model_bytes(view.world.mj_model).tobytes()).digest()
        if key not in _DRAWN:
            _DRAWN[key] = draw()
        # Outside of inference mode: the tensor outlives the mode of the call that comes first.
        with torch.inference_mode(False):
            known[rule] = torch.tensor(_DRAWN[key], dtype=torch.float32, device=view.device)
    return known[rule]
