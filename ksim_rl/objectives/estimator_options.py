"""Checks the options of TorchRL's value estimators: ours take some and refuse others by name."""

from typing import Any

IN_ROWS = "all env states are in one batch, which the critic takes at once"
NO_GRADIENT = "advantages are constants of the losses here; TorchRL's estimators track gradients"
REFUSED: dict[str, tuple[tuple[Any, ...], str]] = {
    "shifted": (
        (False, None),
        "the critic sees both observations of each step, so that no step is left out",
    ),
    "shifted_budget": ((1,), "it goes with shifted=True"),
    "differentiable": ((False, None), NO_GRADIENT),
    "vectorized": (
        (False, None),
        "the loop over steps gives the same numbers, and never waits for the device",
    ),
    "average_rewards": ((False, None), "scale rewards in the env, or by its transforms"),
    "auto_reset_env": (
        (False, None),
        "the value after a step is computed from its true next observation",
    ),
    "group_key": ((None,), "advantages are standardized over all env states"),
    "deactivate_vmap": ((False, True, None), ""),
    "value_chunk_size": ((None,), IN_ROWS),
    "num_chunks": ((None,), IN_ROWS),
    "num_chunk": ((None,), IN_ROWS),
    "value_chunk_dim": ((0,), IN_ROWS),
}
"""Options of TorchRL's estimators: the values that ours honour, and why others are refused."""


def normalizes(normalize_advantage: bool, options: dict[str, Any]) -> bool:
    """Return whether advantages are standardized, also by TorchRL's names for it, which leave the options."""
    stock = [name for name in ("average_gae", "average_adv") if options.pop(name, False)]
    return normalize_advantage or bool(stock)


def check_options(owner: str, options: dict[str, Any]) -> None:
    """Take the options that change nothing here out of those for TorchRL's class; a ValueError refuses the others."""
    for name, (neutral, reason) in REFUSED.items():
        value = options.pop(name, neutral[0])
        if value not in neutral:
            raise ValueError(f"{owner}: {name}={value!r} is not taken: {reason}; leave it out")
