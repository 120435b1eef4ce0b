"""This module keeps the states of recurrent networks between rollouts, and renews them before training sequences."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from ksim_rl.modules.recurrent import RESET_KEY, RecurrentModule, carried_keys, memories, next_key


class CarriedState:
    """The states of networks that do not act, such as a critic: no rollout holds them.

    A critic runs through a rollout when advantages are estimated, all steps at once, from the state in which it left
    the rollout before. That state is kept here. `is_init` at the first step says where it must not be used.

    Args:
        network: whose states are carried.
        acting: networks whose states the rollouts hold already.

    Raises:
        ValueError: if a memory of `network` does not give the state after each step of a sequence.
    """

    def __init__(self, network: nn.Module, *, acting: nn.Module) -> None:
        for memory in memories(network):
            if not isinstance(memory, RecurrentModule):
                raise ValueError(
                    f"critic={type(memory).__name__}: the values after each step need the state there, which TorchRL's "
                    "modules give for the last step of a sequence only; use a RecurrentModule (make_recurrent_critic), "
                    "or a critic without a memory"
                )
        self._memories = [memory for memory in memories(network) if memory not in memories(acting)]
        self._state_E: dict[Any, Tensor] = {}

    @property
    def keys(self) -> list[Any]:
        """Where the states lie in a rollout."""
        return [key for memory in self._memories for key in memory.state_keys]

    def begin_(self, rollout_ET: TensorDictBase) -> None:
        """Write the carried states into a rollout `["E","T"]`, of whose steps only the first is meant."""
        num_envs, num_steps = rollout_ET.batch_size
        for memory in self._memories:
            for key in memory.state_keys:
                if key not in self._state_E:
                    shape = (num_envs, memory.cfg.num_layers, memory.cfg.hidden_dim)
                    self._state_E[key] = torch.zeros(shape, device=rollout_ET.device)
                state_E = self._state_E[key]
                rollout_ET.set(key, state_E.unsqueeze(1).expand(-1, num_steps, -1, -1))

    @torch.no_grad()
    def end_(self, rollout_ET: TensorDictBase) -> None:
        """Write the state before each step, and keep the last; those after each step lie under "next"."""
        for key in self.keys:
            after_ET, state_E = rollout_ET.get(("next", *key)), self._state_E[key]
            before_ET = torch.cat([state_E.unsqueeze(1), after_ET[:, :-1]], 1)
            rollout_ET.set(key, before_ET.masked_fill_(rollout_ET.get(RESET_KEY).unsqueeze(-1), 0.0))
            state_E.copy_(after_ET[:, -1])

    def state_dict(self) -> dict[str, Float[Tensor, "E N H"]]:
        """Return the states by flat key."""
        return {".".join(key): state_E for key, state_E in self._state_E.items()}

    def load_state_dict(
        self, state: Mapping[str, Float[Tensor, "E N H"]], *, device: torch.device | str = "cpu"
    ) -> None:
        """Continue where `state_dict` was taken; tensors keep their addresses.

        Raises:
            ValueError: if the states are of other networks or another number of envs.
        """
        keys = {".".join(key): key for key in self.keys}
        if state and state.keys() != keys.keys():
            raise ValueError(
                f"recurrent state: {sorted(state)} in the checkpoint, {sorted(keys)} in this run"
            )
        for name, saved_E in state.items():
            present_E = self._state_E.setdefault(keys[name], torch.empty_like(saved_E, device=device))
            if present_E.shape != saved_E.shape:
                raise ValueError(
                    f"recurrent state {name!r} is {list(saved_E.shape)} in the checkpoint and "
                    f"{list(present_E.shape)} in this run"
                )
            present_E.copy_(saved_E)


@torch.no_grad()
def burnt_in(
    sequences_BT: TensorDictBase, *networks: nn.Module, steps: int, key: str = "burn_in"
) -> TensorDictBase:
    """Renew the states by the first k steps of sequences, with the networks as they are now, and return the rest.

    No gradient reaches those steps, and no loss sees them.

    Args:
        sequences_BT: `["B", "T"]` with T = k + L, as `SequenceSampler` gives them.
        networks: whose states are renewed.
        steps: k; 0 returns the sequences as they are.
        key: of the flags, bool [B, T, 1], that tell which sequences have k steps before them; the others begin with the
            state that is stored with them.

    Returns:
        `["B", "T"]` with T = L.
    """
    if not steps:
        return sequences_BT
    length = sequences_BT.batch_size[1] - steps
    before_BT, rest_BT = sequences_BT.split([steps, length], 1)
    renewed_B1 = before_BT.get(key)[:, -1]
    for memory in memories(*networks):
        with set_recurrent_mode(True):
            unrolled_BT = memory(before_BT.select(*memory.in_keys))
        for state_key in carried_keys(memory):
            renewed_B = unrolled_BT.get(next_key(state_key))[:, -1]
            state_B = torch.where(renewed_B1.unsqueeze(-1), renewed_B, before_BT.get(state_key)[:, 0])
            rest_BT.set(state_key, state_B.unsqueeze(1).expand_as(rest_BT.get(state_key)))
    return rest_BT
