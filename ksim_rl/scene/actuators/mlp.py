"""A learned motor model that sees a short history."""

import json
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from ksim_rl.checks import check_choice
from ksim_rl.scene.actuators.actuator import Law
from ksim_rl.scene.actuators.drive import Drive
from ksim_rl.scene.actuators.net_actuator import NetActuator
from ksim_rl.scene.actuators.net_file import NetFile
from ksim_rl.scene.actuators.substep_ring import SubstepRing
from ksim_rl.scene.state.joint_targets import JointState, JointTarget

ACTIVATIONS = {
    "elu": nn.ELU,
    "relu": nn.ReLU,
    "softsign": nn.Softsign,
    "tanh": nn.Tanh,
}


@dataclass(frozen=True, kw_only=True)
class MLPActuator(NetActuator):
    """A feed-forward network of the position errors and velocities at some past substeps.

    The file holds what `nn.Sequential(Linear, activation, Linear, ...).state_dict()` gives: `0.weight` [H, F],
    `0.bias` [H], `2.weight`, ... The F inputs are the position errors at `input_lags`, in that order, then the
    velocities; the output is one number. After a reset the first state counts as having been there before.

    Attributes:
        activation: "elu", "relu", "softsign" or "tanh". None: the file's metadata `activation`.
        input_lags: physics substeps, 0 is the present. None: the file's metadata `input_lags`, such as "[0, 2, 4]".
    """

    activation: Literal["elu", "relu", "softsign", "tanh"] | None = None
    input_lags: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.input_lags is not None:
            _check_lags("input_lags", self.input_lags)

    def law(self, drive: Drive) -> Law:
        """Load the network, and return it with its history."""
        net = self.read()
        position_scale, velocity_scale, effort_scale = self.scales(net)
        lags = self._lags(net)
        activation = self.setting(net, "activation")
        check_choice(f"{net.where}: activation", activation, ACTIVATIONS)
        layers = _layers(net, 2 * len(lags), ACTIVATIONS[activation]).to(drive.device)
        seen = SubstepRing(drive, "seen", max(lags) + 1, 2 * drive.num_joints)

        def effort_EN(state: JointState, target: JointTarget) -> Tensor:
            error_EN = (target.pos_EN - state.pos_EN) * position_scale
            seen.push(torch.cat((error_EN, state.vel_EN * velocity_scale), dim=1))
            errors, velocities = zip(*(seen.at(lag).chunk(2, dim=1) for lag in lags), strict=True)
            inputs_ENF = torch.stack((*errors, *velocities), dim=-1)
            limit_EN = drive.param("effort_limit")
            return (layers(inputs_ENF)[..., 0] * effort_scale).clamp(-limit_EN, limit_EN)

        return effort_EN

    def _lags(self, net: NetFile) -> tuple[int, ...]:
        lags = self.setting(net, "input_lags")
        if isinstance(lags, str):
            name = f"{net.where}: input_lags"
            try:
                lags = tuple(json.loads(lags))
            except (TypeError, ValueError):
                raise ValueError(
                    f"{name}={lags!r} in its metadata: expected a list such as [0, 2, 4]"
                ) from None
            _check_lags(name, lags)
        return lags


def _check_lags(name: str, lags: tuple[int, ...]) -> None:
    whole = all(isinstance(lag, int) and not isinstance(lag, bool) and lag >= 0 for lag in lags)
    if not lags or not whole:
        raise ValueError(f"{name}={lags!r}: expected whole numbers of substeps of at least 0")


def _layers(net: NetFile, num_inputs: int, activation: type[nn.Module]) -> nn.Sequential:
    """Build the network of a file, checked layer by layer."""
    numbers = sorted(
        int(name.removesuffix(".weight"))
        for name in net.tensors
        if name.endswith(".weight") and name.removesuffix(".weight").isdecimal()
    )
    if not numbers:
        net.tensor("0.weight", -1, num_inputs)
    net.check_all_known({f"{number}.{part}" for number in numbers for part in ("weight", "bias")})
    layers: list[nn.Module] = []
    width = num_inputs
    for number in numbers:
        outputs = 1 if number == numbers[-1] else -1
        weight = net.tensor(f"{number}.weight", outputs, width)
        bias = net.tensor(f"{number}.bias", weight.shape[0])
        width = weight.shape[0]
        linear = nn.Linear(weight.shape[1], width)
        linear.weight.data, linear.bias.data = weight.clone(), bias.clone()
        layers += [linear, activation()]
    return nn.Sequential(*layers[:-1]).requires_grad_(False)
