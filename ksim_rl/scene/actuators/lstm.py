"""A learned motor model that remembers."""

import re
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from ksim_rl.scene.actuators.actuator import Law
from ksim_rl.scene.actuators.drive import Drive
from ksim_rl.scene.actuators.net_actuator import NetActuator
from ksim_rl.scene.actuators.net_file import NetFile
from ksim_rl.scene.state.joint_targets import JointState, JointTarget

_NUM_INPUTS = 2
_PARTS = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")


@dataclass(frozen=True, kw_only=True)
class LSTMActuator(NetActuator):
    """A recurrent network of position error and velocity, which advances by one step per physics substep.

    The file holds the state of a module with `lstm = nn.LSTM(2, H, num_layers)` and `head = nn.Linear(H, 1)`:
    `lstm.weight_ih_l0` [4 H, 2], `lstm.weight_hh_l0`, `lstm.bias_ih_l0`, `lstm.bias_hh_l0`, further layers, and
    `head.weight`, `head.bias`. Rows that reset start with hidden and cell state zero, as `nn.LSTM` does.
    """

    def law(self, drive: Drive) -> Law:
        """Load the network, and return it with its state."""
        net = self.read()
        position_scale, velocity_scale, effort_scale = self.scales(net)
        loaded = _weights(net)
        layers = [[weight.to(drive.device) for weight in layer] for layer in loaded.layers]
        head, head_bias = loaded.head.to(drive.device), loaded.head_bias.to(drive.device)
        size = head.shape[1]
        num_rows = drive.num_envs * drive.num_joints
        memories = [
            tuple(drive.buffer(f"{kind}{layer}_ENH", drive.num_joints, size) for kind in ("hidden", "cell"))
            for layer in range(len(layers))
        ]

        def effort_EN(state: JointState, target: JointTarget) -> Tensor:
            error_EN = (target.pos_EN - state.pos_EN) * position_scale
            inputs_ENF = torch.stack((error_EN, state.vel_EN * velocity_scale), dim=-1)
            value = inputs_ENF.view(num_rows, _NUM_INPUTS)
            for (hidden_ENH, cell_ENH), layer in zip(memories, layers, strict=True):
                hidden, cell = hidden_ENH.view(num_rows, size), cell_ENH.view(num_rows, size)
                value, next_cell = torch.lstm_cell(value, (hidden, cell), *layer)
                hidden.copy_(value)
                cell.copy_(next_cell)
            predicted = functional.linear(value, head, head_bias) * effort_scale
            limit_EN = drive.param("effort_limit")
            return predicted.view(drive.num_envs, drive.num_joints).clamp(-limit_EN, limit_EN)

        return effort_EN


class _Weights(NamedTuple):
    """Four tensors per layer, in the order of `_PARTS`, and the read-out."""

    layers: list[list[Tensor]]
    head: Tensor
    head_bias: Tensor


def _weights(net: NetFile) -> _Weights:
    """Return the weights of a file, checked."""
    found = [re.fullmatch(r"lstm\.weight_ih_l(\d+)", name) for name in net.tensors]
    num_layers = max(1, sum(match is not None for match in found))
    size = net.tensor("lstm.weight_hh_l0", -1, -1).shape[1]
    layers: list[list[Tensor]] = []
    for layer in range(num_layers):
        width = size if layer else _NUM_INPUTS
        shapes = ((4 * size, width), (4 * size, size), (4 * size,), (4 * size,))
        layers.append(
            [net.tensor(f"lstm.{part}_l{layer}", *shape) for part, shape in zip(_PARTS, shapes, strict=True)]
        )
    names = {f"lstm.{part}_l{layer}" for part in _PARTS for layer in range(num_layers)}
    net.check_all_known(names | {"head.weight", "head.bias"})
    return _Weights(layers, net.tensor("head.weight", 1, size), net.tensor("head.bias", 1))
