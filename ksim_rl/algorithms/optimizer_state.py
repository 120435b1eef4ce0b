"""This module turns the state of an optimizer with one group of parameters into what a checkpoint holds, and back."""

from collections.abc import Mapping
from typing import Any

import torch

from ksim_rl.device.state_tree import State
from ksim_rl.objectives import load_optimizer_state_


def optimizer_state(optimizer: torch.optim.Optimizer) -> State:
    """Return learning rate and moments; a parameter that no loss has reached has an empty entry."""
    state = optimizer.state_dict()
    group = state["param_groups"][0]
    moments = {index: state["state"].get(index, {}) for index in range(len(group["params"]))}
    return {"learning_rate": group["lr"], "moments": moments}


def load_optimizer_state(optimizer: torch.optim.Optimizer, state: Mapping[str, Any], *, what: str) -> None:
    """Continue where `optimizer_state` was taken.

    Raises:
        ValueError: naming what does not fit this optimizer's parameters.
    """
    parameters = optimizer.param_groups[0]["params"]
    moments = {int(index): entry for index, entry in state["moments"].items()}
    if set(moments) != set(range(len(parameters))):
        raise ValueError(
            f"{what}: {len(moments)} parameters in the checkpoint, {len(parameters)} in this run"
        )
    moments = {index: entry for index, entry in moments.items() if entry}
    for index, entry in moments.items():
        for name in ("exp_avg", "exp_avg_sq"):
            if entry[name].shape != parameters[index].shape:
                raise ValueError(
                    f"{what}: {name} of parameter {index} has shape {list(entry[name].shape)} in the checkpoint and "
                    f"{list(parameters[index].shape)} in this run"
                )
    groups = optimizer.state_dict()["param_groups"]
    groups[0] = groups[0] | {"lr": state["learning_rate"]}
    load_optimizer_state_(optimizer, {"state": moments, "param_groups": groups})
