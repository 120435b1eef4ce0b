"""Measures networks and actions in some env states of a rollout, for faults that losses do not show."""

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.modules import ACTIVATIONS, ObservationNormalizer, recurrent_modules

# Enough to tell a unit that is constant from one that is rarely active.
NUM_ENV_STATES = 512
# A unit whose output moves less than that over all of them says nothing.
LEAST_MOVEMENT = 1e-3
# Share of an action's range: an action nearer to a bound counts as on it.
BOUND_SHARE = 0.005


@torch.no_grad()
def probed(update: Any, env: EnvBase, rollout_ET: TensorDictBase | None) -> dict[str, float]:
    """Return statistics of an update's `actor` and `critic`, and of the actions, in a rollout `["E","T"]`.

    `policy/dead_units` is the share of hidden units whose output is the same in all of its first env states,
    `policy/observation_rms` the root mean square of the normalizers' outputs there, 1 where their statistics fit, and
    `rollout/saturated_actions` the share of actions on their bounds or beyond. Figures that do not exist are left out,
    as are the networks where one is recurrent. Nothing is drawn or learned; the figures are read on the host.
    """
    if rollout_ET is None:
        return {}
    networks = [
        network
        for name in ("actor", "critic")
        if (network := getattr(update, name, None)) is not None
    ]
    ranges: list[Tensor] = []
    squares: list[Tensor] = []
    num_envs = max(1, NUM_ENV_STATES // rollout_ET.shape[1])
    for network in [] if recurrent_modules(*networks) else networks:
        if any(rollout_ET.get(key, None) is None for key in network.in_keys):
            continue  # an update may keep less of a rollout than a network reads
        # As new tensors: outputs of networks must not reach the rollout.
        env_states_B = rollout_ET[:num_envs].select(*network.in_keys).reshape(-1)
        with _heard(network, ranges, squares), set_exploration_type(ExplorationType.DETERMINISTIC):
            network(env_states_B)
    figures = _saturated(env, rollout_ET)
    if ranges:
        moves_U = torch.cat([movement.flatten() for movement in ranges])
        figures["policy/dead_units"] = (moves_U < LEAST_MOVEMENT).to(torch.float32).mean()
    if squares:
        figures["policy/observation_rms"] = torch.stack(squares).mean().sqrt()
    return {name: float(figure) for name, figure in figures.items()}


def _heard(network: nn.Module, ranges: list[Tensor], squares: list[Tensor]) -> ExitStack:
    """Note, while the block runs, how far each hidden unit moves over the batch, and the squares of observations."""

    def note_range(_module: nn.Module, _inputs: Any, output: Tensor) -> None:
        ranges.append(output.amax(-2) - output.amin(-2))

    def note_square(_module: nn.Module, _inputs: Any, output: Tensor) -> None:
        squares.append(output.square().mean())

    stack = ExitStack()
    kinds = tuple(ACTIVATIONS.values())
    for module in network.modules():
        if isinstance(module, kinds):
            hook: Callable[..., None] | None = note_range
        else:
            hook = None
        if isinstance(module, ObservationNormalizer):
            hook = note_square
        if hook is not None:
            stack.callback(module.register_forward_hook(hook).remove)
    return stack


def _saturated(env: EnvBase, rollout_ET: TensorDictBase) -> dict[str, Tensor]:
    spec: Any = env.full_action_spec
    action_ET = rollout_ET.get("action", None)
    alone = list(spec.keys(True, True)) == ["action"] and isinstance(spec["action"], Bounded)
    if not alone or action_ET is None or not action_ET.is_floating_point():
        return {}
    low = spec["action"].space.low
    high = spec["action"].space.high
    if not bool((high - low).isfinite().all()):
        return {}
    margin = BOUND_SHARE * (high - low)
    # [E, 1, A] beside [E, T, A].
    lowest = (low + margin).unsqueeze(1)
    highest = (high - margin).unsqueeze(1)
    inside = (action_ET > lowest) & (action_ET < highest)
    return {"rollout/saturated_actions": 1.0 - inside.to(torch.float32).mean()}
