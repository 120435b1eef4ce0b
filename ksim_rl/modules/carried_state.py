"""The states of recurrent networks between rollouts, and before the part of a sequence that a loss reads."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from ksim_rl.device.state_tree import copy_into
from ksim_rl.modules.recurrent import RESET_KEY, RecurrentModule, carried_keys, recurrent_modules


class CarriedState:
    """The states of networks that do not act, such as a critic: no rollout holds them.

    A critic runs through a rollout when advantages are estimated, all steps together, from the state in which it left
    the rollout before. That state is kept here. `is_init` at the first step says where it must not be used. Networks
    that are a part of `acting` have theirs in the rollouts. Raises ValueError where a recurrent module of `network`
    does not give the state after each step of a sequence.
    """

    def __init__(self, network: nn.Module, *, acting: nn.Module) -> None:
        # Modules that act have their states in the rollouts already.
        acts = recurrent_modules(acting)
        self._recurrent = [module for module in recurrent_modules(network) if module not in acts]
        for module in recurrent_modules(network):
            if not isinstance(module, RecurrentModule):
                raise ValueError(
                    f"critic={type(module).__name__}: the values after each step need the state there, which TorchRL's "
                    "modules give for the last step of a sequence only; use a RecurrentModule (make_recurrent_critic), "
                    "or a critic that is not recurrent"
                )
        self._state_E: dict[Any, Tensor] = {}

    @property
    def keys(self) -> list[Any]:
        """Where the states lie in a rollout."""
        return [key for module in self._recurrent for key in module.state_keys]

    def begin_(self, rollout_ET: TensorDictBase) -> None:
        """Write the carried states into a rollout `["E","T"]`, of whose steps only the first is meant."""
        num_envs, num_steps = rollout_ET.batch_size
        for module in self._recurrent:
            for key in module.state_keys:
                # The first rollout tells the number of envs; its first step begins from zeros.
                if key not in self._state_E:
                    shape = (num_envs, module.cfg.num_layers, module.cfg.hidden_dim)
                    self._state_E[key] = torch.zeros(shape, device=rollout_ET.device)
                state_E = self._state_E[key]
                rollout_ET.set(key, state_E.unsqueeze(1).expand(-1, num_steps, -1, -1))

    @torch.no_grad()
    def end_(self, rollout_ET: TensorDictBase) -> None:
        """Write the state before each step, and keep the last; those after each step lie under "next"."""
        for key in self.keys:
            after_ET = rollout_ET.get(("next", *key))
            state_E = self._state_E[key]
            # The state before a step is the one after the step before it, and zero where an episode begins.
            before_ET = torch.cat([state_E.unsqueeze(1), after_ET[:, :-1]], 1)
            rollout_ET.set(
                key, before_ET.masked_fill_(rollout_ET.get(RESET_KEY).unsqueeze(-1), 0.0)
            )
            state_E.copy_(after_ET[:, -1])

    def state_dict(self) -> dict[str, Float[Tensor, "E N H"]]:
        """Return the states by flat key."""
        return {".".join(key): state_E for key, state_E in self._state_E.items()}

    def load_state_dict(
        self, state: Mapping[str, Float[Tensor, "E N H"]], *, device: torch.device | str = "cpu"
    ) -> None:
        """Continue where `state_dict` was taken; tensors keep their addresses."""
        keys = {".".join(key): key for key in self.keys}
        for name in keys.keys() & state.keys():
            # A new run has no tensors yet to copy into.
            self._state_E.setdefault(keys[name], torch.empty_like(state[name], device=device))
        if state:
            copy_into(self.state_dict(), state, what="recurrent state")
        else:
            for state_E in self._state_E.values():
                state_E.zero_()


@torch.no_grad()
def burnt_in(
    sequences_BT: TensorDictBase, *networks: nn.Module, steps: int, key: str = "burn_in"
) -> TensorDictBase:
    """Renew the states by the first `steps` of sequences, with the networks as they are now, and return the rest.

    No gradient reaches those steps, and no loss sees them. Sequences are `["B", "T"]`, as `SequenceSampler` gives them;
    the flags at `key` tell which have such steps before them. The others begin with the state that is stored with them.
    """
    if not steps:
        return sequences_BT
    # The steps of the burn-in come first in each sequence.
    length = sequences_BT.batch_size[1] - steps
    before_BT, rest_BT = sequences_BT.split([steps, length], 1)
    # Sequences at the start of a rollout have no steps before them, and keep the stored state.
    renewed_B1 = before_BT.get(key)[:, -1]
    for module in recurrent_modules(*networks):
        # The steps of the burn-in run as a sequence, from the stored state.
        with set_recurrent_mode(True):
            unrolled_BT = module(before_BT.select(*module.in_keys))
        for state_key in carried_keys(module):
            renewed_B = unrolled_BT.get(unravel_key(("next", state_key)))[:, -1]
            state_B = torch.where(
                renewed_B1.unsqueeze(-1), renewed_B, before_BT.get(state_key)[:, 0]
            )
            rest_BT.set(state_key, state_B.unsqueeze(1).expand_as(rest_BT.get(state_key)))
    return rest_BT
