"""Learned motor models: networks whose weights and settings stand in a safetensors file."""

import hashlib
import json
import re
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor, nn
from torch.nn import functional

from ksim_rl.checked import Filled, WholeNumber, check_value
from ksim_rl.checks import check_choice, check_in_range, near
from ksim_rl.files.reading import MOST_DATA_BYTES, read_bytes
from ksim_rl.scene.actuators.actuator import Drive, ExplicitActuator, Law, SubstepRing
from ksim_rl.scene.state.joint_targets import JointState, JointTarget

ACTIVATIONS = {"elu": nn.ELU, "relu": nn.ReLU, "softsign": nn.Softsign, "tanh": nn.Tanh}
_SCALES = ("position_scale", "velocity_scale", "effort_scale")
_LSTM_PARTS = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")

Lags = Annotated[
    tuple[WholeNumber, ...], Filled("expected whole numbers of substeps of at least 0")
]
Predictor = Callable[[Float[Tensor, "E N"], Float[Tensor, "E N"]], Float[Tensor, "E N"]]
"""A network at work: efforts [E, N] from position errors [E, N] and velocities [E, N]."""


class NetFile:
    """The `tensors` (float32) and `metadata` (text) of a safetensors file, by name; nothing in it is ever executed.

    A ValueError with path and SHA-256 (`where`) if it is missing, damaged, or its bytes hash to anything but `sha256`.
    """

    def __init__(self, file: str, sha256: str | None) -> None:
        try:
            # A limit on the bytes keeps a wrong path from filling the memory.
            data = read_bytes(Path(file).expanduser(), limit=MOST_DATA_BYTES, follows_links=True)
        except ValueError as error:
            raise ValueError(f"file={file!r}: {error}: expected a safetensors file") from None
        digest = hashlib.sha256(data).hexdigest()
        self.where = f"file={file!r} (SHA-256 {digest})"
        # Before the bytes are parsed: nothing of a wrong file is used.
        if sha256 is not None and digest != sha256.lower():
            raise ValueError(
                f"{self.where}: expected sha256={sha256!r}: the file is damaged, or another one"
            )
        try:
            tensors = load(data)
        except SafetensorError as error:
            raise ValueError(
                f"{self.where}: no safetensors file: {' '.join(str(error).split())}"
            ) from None
        # The header: its length in 8 bytes, then JSON (https://github.com/huggingface/safetensors#format).
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        self.tensors = {name: tensor.to(torch.float32) for name, tensor in tensors.items()}
        self.metadata: dict[str, str] = header.get("__metadata__", {})

    def tensor(self, name: str, *shape: int) -> Float[Tensor, "*shape"]:
        """Return a tensor of finite numbers and of this shape, where -1 fits any size."""
        if name not in self.tensors:
            raise ValueError(f"{self.where}: no tensor {name!r}: {near(name, self.tensors)}")
        tensor = self.tensors[name]
        # A wanted size of -1 fits any.
        fits = tensor.ndim == len(shape) and all(
            wanted in (-1, found) for wanted, found in zip(shape, tensor.shape, strict=True)
        )
        if not fits:
            wanted = ", ".join(str(size) for size in shape).replace("-1", "any")
            raise ValueError(
                f"{self.where}: {name} has shape {tuple(tensor.shape)}: expected ({wanted})"
            )
        # A NaN in a weight would become a NaN in the state.
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{self.where}: {name} holds numbers that are not finite")
        return tensor

    def check_all_known(self, names: set[str]) -> None:
        """Refuse tensors that the net would not use, by a ValueError that names them."""
        # A file for another kind of net would load in part, and mislead.
        unknown = sorted(self.tensors.keys() - names)
        if unknown:
            raise ValueError(f"{self.where}: unknown tensors {unknown}: expected {sorted(names)}")


@dataclass(frozen=True, kw_only=True)
class NetActuator(ExplicitActuator):
    """A motor whose effort a small network predicts from position errors and velocities, joint by joint.

    One network serves all joints of the entry, as in Hwangbo et al., "Learning agile and dynamic motor skills for
    legged robots", Science Robotics 4 (2019). Its effort is kept inside the effort limit.

    Attributes:
        file: path of a safetensors file with the weights, whose bytes hash to `sha256` (hexadecimal) unless that is
            None.
        position_scale, velocity_scale: multiply position errors (target - position, rad or m) and velocities (rad/s or
            m/s) on their way in, `effort_scale` the output, which gives N m or N. None: the file's metadata, else 1.
    """

    takes = frozenset({"pos"})

    counts_substeps: ClassVar[bool] = True

    file: str
    sha256: str | None = None
    position_scale: float | None = None
    velocity_scale: float | None = None
    effort_scale: float | None = None

    def data_files(self) -> Sequence[str]:
        """Return the file of the weights."""
        return (self.file,)

    @abstractmethod
    def load(self, net: NetFile, drive: Drive) -> Predictor:
        """Return the network of a file, with the buffers that it needs; inputs and output are scaled already."""

    def law(self, drive: Drive) -> Law:
        net = NetFile(self.file, self.sha256)
        # Metadata is text; scales are numbers.
        position_scale, velocity_scale, effort_scale = (
            float(self.setting(net, name, 1.0)) for name in _SCALES
        )
        # In construction: buffers are made now, and the weights go to the device.
        predict = self.load(net, drive)

        def effort_EN(state: JointState, target: JointTarget) -> Tensor:
            error_EN = (target.pos_EN - state.pos_EN) * position_scale
            predicted_EN = predict(error_EN, state.vel_EN * velocity_scale) * effort_scale
            # Read at each substep: events may change it between worlds.
            limit_EN = drive.param("effort_limit")
            return predicted_EN.clamp(-limit_EN, limit_EN)

        return effort_EN

    def setting(self, net: NetFile, name: str, default: Any = None) -> Any:
        """Return a field or, if that is None, the metadata of its name, as text, or the default."""
        # The config wins over the file.
        value = getattr(self, name)
        if value is not None:
            return value
        text = net.metadata.get(name)
        if text is None:
            if default is None:
                raise ValueError(
                    f"{net.where}: no {name!r} in its metadata: give the field `{name}`"
                )
            return default
        if name in _SCALES:
            try:
                number = float(text)
            except ValueError:
                raise ValueError(
                    f"{net.where}: {name}={text!r} in its metadata: expected a number"
                ) from None
            check_in_range(f"{net.where}: {name}", number)
            return number
        return text


@dataclass(frozen=True, kw_only=True)
class MLPActuator(NetActuator):
    """A feed-forward network of the position errors and velocities at some past substeps.

    The file holds the `state_dict()` of `nn.Sequential(Linear, activation, Linear, ...)`: `0.weight` [H, F], `0.bias`
    [H], `2.weight`, ... The F inputs are the position errors at `input_lags` (physics substeps, 0 is the present), in
    that order, then the velocities; the output is one number. After a reset the first state counts as having been there
    before. A field that is None is read from the file's metadata, such as `input_lags` "[0, 2, 4]".
    """

    activation: Literal["elu", "relu", "softsign", "tanh"] | None = None
    input_lags: Lags | None = None

    def load(self, net: NetFile, drive: Drive) -> Predictor:
        lags = self._lags(net)
        activation = self.setting(net, "activation")
        check_choice(f"{net.where}: activation", activation, ACTIVATIONS)
        # A position error and a velocity for each lag.
        layers = _layers(net, 2 * len(lags), ACTIVATIONS[activation]).to(drive.device)
        # As long as the longest lag, and the present; both signals side by side, [E, 2 N].
        seen = SubstepRing(drive, "seen", max(lags) + 1, 2 * drive.num_joints)

        def predict(
            error_EN: Float[Tensor, "E N"], vel_EN: Float[Tensor, "E N"]
        ) -> Float[Tensor, "E N"]:
            seen.push(torch.cat((error_EN, vel_EN), dim=1))
            # Two lists of [E, N], one tensor per lag.
            errors = []
            velocities = []
            for lag in lags:
                error, velocity = seen.at(lag).chunk(2, dim=1)
                errors.append(error)
                velocities.append(velocity)
            # [E, N, F]: a linear layer works on the last dim, for all joints alike.
            return layers(torch.stack((*errors, *velocities), dim=-1))[..., 0]

        return predict

    def _lags(self, net: NetFile) -> tuple[int, ...]:
        lags = self.setting(net, "input_lags")
        if isinstance(lags, str):
            # Metadata is text, a list in JSON.
            name = f"{net.where}: input_lags"
            try:
                lags = tuple(json.loads(lags))
            except (TypeError, ValueError):
                raise ValueError(
                    f"{name}={lags!r} in its metadata: expected a list such as [0, 2, 4]"
                ) from None
            check_value(name, lags, Lags)
        return lags


def _layers(net: NetFile, num_inputs: int, activation: type[nn.Module]) -> nn.Sequential:
    """Build the network of a file, checked layer by layer."""
    # `nn.Sequential` numbers activations too, so that numbers of layers have gaps.
    numbers = sorted(
        int(name.removesuffix(".weight"))
        for name in net.tensors
        if name.endswith(".weight") and name.removesuffix(".weight").isdecimal()
    )
    if not numbers:
        # Fails with the message for a missing tensor.
        net.tensor("0.weight", -1, num_inputs)
    net.check_all_known({f"{number}.{part}" for number in numbers for part in ("weight", "bias")})
    layers: list[nn.Module] = []
    width = num_inputs
    # Each layer takes as many numbers as the one before it gives; the last gives one.
    for number in numbers:
        weight = net.tensor(f"{number}.weight", 1 if number == numbers[-1] else -1, width)
        bias = net.tensor(f"{number}.bias", weight.shape[0])
        linear = nn.Linear(width, weight.shape[0])
        linear.weight.data = weight.clone()
        linear.bias.data = bias.clone()
        layers += [linear, activation()]
        width = weight.shape[0]
    # No activation follows the last layer, and nothing here is trained.
    return nn.Sequential(*layers[:-1]).requires_grad_(False)


@dataclass(frozen=True, kw_only=True)
class LSTMActuator(NetActuator):
    """A recurrent network of position error and velocity, which advances by one step per physics substep.

    The file holds the state of a module with `lstm = nn.LSTM(2, H, num_layers)` and `head = nn.Linear(H, 1)`:
    `lstm.weight_ih_l0` [4 H, 2], `lstm.weight_hh_l0`, `lstm.bias_ih_l0`, `lstm.bias_hh_l0`, further layers, and
    `head.weight`, `head.bias`. Rows that reset start with hidden and cell state zero, as `nn.LSTM` does.
    """

    def load(self, net: NetFile, drive: Drive) -> Predictor:
        # Layers are counted by their names.
        found = [re.fullmatch(r"lstm\.weight_ih_l(\d+)", name) for name in net.tensors]
        num_layers = max(1, sum(match is not None for match in found))
        # The hidden size is the second dim of the recurrent weights.
        size = net.tensor("lstm.weight_hh_l0", -1, -1).shape[1]
        layers: list[list[Tensor]] = []
        for layer in range(num_layers):
            # The first layer sees two numbers, later ones the layer below; four gates are stacked.
            width = size if layer else 2
            gates = 4 * size
            shapes = ((gates, width), (gates, size), (gates,), (gates,))
            parts = zip(_LSTM_PARTS, shapes, strict=True)
            layers.append([net.tensor(f"lstm.{part}_l{layer}", *shape) for part, shape in parts])
        names = {f"lstm.{part}_l{layer}" for part in _LSTM_PARTS for layer in range(num_layers)}
        # After the layers, since their number decides which names are known.
        net.check_all_known(names | {"head.weight", "head.bias"})
        head = net.tensor("head.weight", 1, size)
        head_bias = net.tensor("head.bias", 1)
        # Checked on the CPU, then moved.
        on_device = []
        for layer in layers:
            on_device.append([weight.to(drive.device) for weight in layer])
        layers = on_device
        head = head.to(drive.device)
        head_bias = head_bias.to(drive.device)
        # An env's joint is a row of the batch: all share one net.
        num_rows = drive.num_envs * drive.num_joints
        # Zeroed at resets, which is the state that `nn.LSTM` starts from.
        buffers = [
            tuple(
                drive.buffer(f"{kind}{layer}_ENH", drive.num_joints, size)
                for kind in ("hidden", "cell")
            )
            for layer in range(num_layers)
        ]

        def predict(
            error_EN: Float[Tensor, "E N"], vel_EN: Float[Tensor, "E N"]
        ) -> Float[Tensor, "E N"]:
            # Position error, then velocity, as in training.
            value = torch.stack((error_EN, vel_EN), dim=-1).view(num_rows, 2)
            for (hidden_ENH, cell_ENH), layer in zip(buffers, layers, strict=True):
                hidden = hidden_ENH.view(num_rows, size)
                cell = cell_ENH.view(num_rows, size)
                value, next_cell = torch.lstm_cell(value, (hidden, cell), *layer)
                # In place: the buffers are the env's state, which resets clear.
                hidden.copy_(value)
                cell.copy_(next_cell)
            return functional.linear(value, head, head_bias).view(drive.num_envs, drive.num_joints)

        return predict
