"""Turns a policy into a file: its deterministic action, with normalization and recurrent state inside."""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import torch
from jaxtyping import Float, Shaped
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn import functional

from ksim_rl.export.onnx_file import quiet, write_onnx
from ksim_rl.export.picture_inputs import PictureInput
from ksim_rl.modules.action_heads import PARAMETERS, MixedHead
from ksim_rl.modules.network import side_by_side
from ksim_rl.modules.recurrent import RecurrentModule


@dataclass(frozen=True, kw_only=True)
class StateSpec:
    """A state that the policy carries from step to step: an input [batch, *shape] and the output that feeds it next.

    An episode starts with zeros, or with its first frame in all places: columns [start, stop) of the input `of`, or all
    of it.
    """

    input: str
    output: str
    shape: tuple[int, ...]
    starts_with: Literal["zeros", "frame"]
    of: str | None = None
    columns: tuple[int, int] | None = None
    dtype: str = "float32"


def _recurrent_state(name: str, shape: tuple[int, ...]) -> StateSpec:
    return StateSpec(input=f"{name}_in", output=f"{name}_out", shape=shape, starts_with="zeros")


def _history(name: str, shape: tuple[int, ...], **frame: Any) -> StateSpec:
    # It begins with the first frame in all places.
    return StateSpec(
        input=f"history_{name}_in",
        output=f"history_{name}_out",
        shape=shape,
        starts_with="frame",
        **frame,
    )


@dataclass(frozen=True, kw_only=True)
class Column:
    """One term that the policy reads: `size` numbers per frame, and `length` frames that are `stride` steps apart."""

    name: str
    size: int
    length: int = 1
    stride: int = 1


class ExportedPolicy(nn.Module):
    """A policy as a function of tensors: observations and states to the actions [batch, A] and the next states.

    Observations are `obs` [batch, L], the newest frame of every term, side by side, unless the policy only sees, and
    the newest picture [batch, *shape] of each camera. `groups` are the terms of each vector that the actor reads.
    Raises ValueError where the actor has a part that has no such form.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        groups: Mapping[NestedKey, Sequence[Column]],
        pictures: Sequence[PictureInput] = (),
    ) -> None:
        super().__init__()
        self.actor = actor
        # The sequence of modules is run by hand in `forward`: exporters know no TensorDict.
        self.parts = list(_parts(actor))
        self.groups = groups
        self.pictures = list(pictures)
        # A mixed head has one action per distribution, under keys of its own.
        mixed = _mixed_head(self.parts[-1])
        if mixed:
            self.action_keys: list[NestedKey] = mixed.action_keys
        else:
            self.action_keys = ["action"]
        self.states = []
        start = 0
        for column in self.columns:
            # Frames that a history keeps beside the newest one, also those that its stride leaves out.
            if column.length > 1:
                shape = ((column.length - 1) * column.stride, column.size)
                columns = (start, start + column.size)
                self.states.append(_history(column.name, shape, of="obs", columns=columns))
            # Start of the next term in the frame.
            start += column.size
        self.obs_dim = start
        for picture in self.pictures:
            if picture.length > 1:
                shape = ((picture.length - 1) * picture.stride, *picture.shape)
                dtype = str(picture.dtype).removeprefix("torch.")
                self.states.append(_history(picture.name, shape, of=picture.name, dtype=dtype))
        for part in self.parts:
            if isinstance(part, RecurrentModule):
                shape = (part.cfg.num_layers, part.cfg.hidden_dim)
                self.states += [_recurrent_state(key[-1], shape) for key in part.state_keys]

    @property
    def columns(self) -> list[Column]:
        """The terms of a frame, in order."""
        return [column for columns in self.groups.values() for column in columns]

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs: "obs" if there are vectors, pictures, then the states."""
        return [*self.examples(1)]

    def examples(self, rows: int) -> dict[str, Shaped[Tensor, "*?shape"]]:
        """Return zeros for each input, by name and in their order."""
        found = {}
        if self.obs_dim:
            found["obs"] = torch.zeros(rows, self.obs_dim)
        for picture in self.pictures:
            found[picture.name] = torch.zeros(rows, *picture.shape, dtype=picture.dtype)
        for state in self.states:
            dtype = getattr(torch, state.dtype)
            found[state.input] = torch.zeros(rows, *state.shape, dtype=dtype)
        return found

    @property
    def output_names(self) -> list[str]:
        """Names of the outputs: "actions", then the next states."""
        return ["actions", *(state.output for state in self.states)]

    def forward(self, *inputs: Shaped[Tensor, "B *?S"]) -> tuple[Shaped[Tensor, "B *?M"], ...]:
        """Return the actions and the next states for inputs in the order of `input_names`."""
        # Consumed from the front, in their order: histories before recurrent states.
        given = list(inputs)
        after: list[Tensor] = []
        obs_BL = given.pop(0) if self.obs_dim else torch.empty(0)
        newest = [given.pop(0) for _ in self.pictures]
        values = self._vectors(obs_BL, given, after)
        for picture, picture_B in zip(self.pictures, newest, strict=True):
            values[picture.group] = _frames(picture, picture_B, given, after)
        actions: list[Tensor] = []
        for part in self.parts:
            # By the formula of one step: the module itself reads reset flags, which an export has not.
            if isinstance(part, RecurrentModule):
                features, kept = _recurrent(part, values, [given.pop(0) for _ in part.state_keys])
                values[part.feature_key] = features
                after += kept
            elif isinstance(part, ProbabilisticTensorDictModule):
                # The distribution is last: its parameters become the deterministic action.
                actions = _best(part, values)
            else:
                found = part.module(*(values[key] for key in part.in_keys))
                if not isinstance(found, tuple):
                    found = (found,)
                values |= dict(zip(part.out_keys, found, strict=True))
                # TD3 and its like end in a network that writes the action itself.
                if "action" in part.out_keys:
                    actions = [values["action"]]
                else:
                    actions = []
        return torch.cat([as_row(action) for action in actions], -1), *after

    def _vectors(
        self, obs_BL: Tensor, given: list[Tensor], after: list[Tensor]
    ) -> dict[NestedKey, Tensor]:
        """Return the vector of each group; histories are taken from `given`, and the next ones put behind `after`."""
        values: dict[NestedKey, Tensor] = {}
        start = 0
        for group, columns in self.groups.items():
            terms = []
            for column in columns:
                frame = obs_BL[:, start : start + column.size]
                # The frame has terms side by side, in the order of the groups.
                start += column.size
                if column.length > 1:
                    # Oldest first; the oldest frame drops out of the next state.
                    frames = torch.cat((given.pop(0), frame[:, None]), 1)
                    after.append(frames[:, 1:])
                    # Every `stride`-th of (length - 1) * stride + 1 frames: `length` of them, the newest
                    # among them.
                    frame = frames[:, :: column.stride].flatten(1)
                terms.append(frame)
            values[group] = torch.cat(terms, -1)
        return values


def _frames(
    picture: PictureInput, picture_B: Tensor, given: list[Tensor], after: list[Tensor]
) -> Tensor:
    """Return the frames of a camera as the actor reads them: the newest, or stacked behind older ones."""
    if not picture.is_stacked:
        return picture_B
    frames = picture_B[:, None]
    if picture.length > 1:
        frames = torch.cat((given.pop(0), frames), 1)
        after.append(frames[:, 1:])
    return frames[:, :: picture.stride]


def _parts(module: nn.Module) -> Iterator[Any]:
    """Return the parts of nested sequences in the order in which they run."""
    inner = getattr(module, "module", None)
    # Before the general case: both are TensorDictModules, too.
    if isinstance(module, RecurrentModule | ProbabilisticTensorDictModule):
        yield module
    elif isinstance(inner, nn.ModuleList | list | tuple):
        for part in inner:
            yield from _parts(part)
    elif isinstance(module, TensorDictModule) and isinstance(inner, nn.Module):
        yield module
    else:
        raise ValueError(
            f"the policy holds a {type(module).__name__}: an export takes TensorDictModules, RecurrentModules and "
            "distributions one after another; make the policy such a sequence"
        )


def _best(part: Any, values: dict[NestedKey, Tensor]) -> list[Tensor]:
    """Return the deterministic action of each distribution, as `ExplorationType.DETERMINISTIC` does."""
    if mixed := _mixed_head(part):
        # Each head finds its parameters under the key of its action.
        found = []
        heads = cast(Any, mixed.heads)
        for key, head in zip(mixed.action_keys, heads, strict=True):
            if isinstance(key, str):
                path = (PARAMETERS, key)
            else:
                path = (PARAMETERS, *key)
            parameters = {name: values[(*path, name)] for name in head.parameter_names}
            found.append(head.distribution(**parameters).deterministic_sample)
        return found
    parameters = {str(key): values[key] for key in part.in_keys}
    return [part.distribution_class(**parameters, **part.distribution_kwargs).deterministic_sample]


def _mixed_head(part: nn.Module) -> MixedHead | None:
    owner = getattr(getattr(part, "distribution_class", None), "__self__", None)
    if isinstance(owner, MixedHead):
        return owner
    return None


def as_row(action: Shaped[Tensor, " B *M"]) -> Float[Tensor, "B M"]:
    """Return actions, or choices [B], as rows of float32."""
    # Choices are whole numbers of shape [B]; files hold one float32 row per action.
    return (action.flatten(1) if action.ndim > 1 else action[:, None]).float()


def _recurrent(
    part: RecurrentModule, values: dict[NestedKey, Tensor], state: list[Tensor]
) -> tuple[Tensor, list[Tensor]]:
    """Return the features and the state [B, N, H] after one step, by the formulas of `torch.nn.LSTM` and `GRU`."""
    network = part.module
    cfg = part.cfg
    features = side_by_side([values[key] for key in part.obs_keys])
    # As in training: the normalizer is a part of the module.
    if network.normalizer is not None:
        features = network.normalizer(features)
    after: list[tuple[Tensor, ...]] = []
    for layer in range(cfg.num_layers):
        # In torch's own layout: gates are stacked in rows, so that they are split below.
        weights = [
            network.get_parameter(f"{name}_l{layer}")
            for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        ]
        x = functional.linear(features, weights[0], weights[2])
        h = functional.linear(state[0][:, layer], weights[1], weights[3])
        # Torch's order of gates: input, forget, cell, output.
        if cfg.kind == "lstm":
            i, f, g, o = (x + h).chunk(4, -1)
            cell = f.sigmoid() * state[1][:, layer] + i.sigmoid() * g.tanh()
            features = o.sigmoid() * cell.tanh()
            after.append((features, cell))
        else:
            # Torch's order: reset, update, new; the reset gate scales the recurrent part with its bias.
            (rx, zx, nx) = x.chunk(3, -1)
            (rh, zh, nh) = h.chunk(3, -1)
            r = (rx + rh).sigmoid()
            z = (zx + zh).sigmoid()
            n = (nx + r * nh).tanh()
            # Equal to (1 - z) n + z h.
            features = n + z * (state[0][:, layer] - n)
            after.append((features,))
    return features, [torch.stack(parts, 1) for parts in zip(*after, strict=True)]


def write(policy: ExportedPolicy, folder: Path) -> None:
    """Write `policy.onnx` and `policy.pt2`; their batch has any size."""
    # Weights are copied into the files; `eval` stops normalizers from learning.
    policy = policy.to("cpu").eval()
    # Two rows: a batch of one would be taken for a constant.
    example = tuple(policy.examples(2).values())
    batch = torch.export.Dim("batch", min=1, max=2**20)
    # One entry per parameter of `forward`, which has one, a tuple.
    shapes = (tuple({0: batch} for _ in example),)
    # No gradients; warnings of the exporter are not for users.
    with torch.no_grad(), quiet():
        program = torch.export.export(policy, example, dynamic_shapes=shapes)
    # They name the folders of this machine, in files that are made to be given away.
    for node in program.graph.nodes:
        node.meta.pop("stack_trace", None)
    # Torch's writer of files aborts the process where the disk is full.
    memory = io.BytesIO()
    torch.export.save(program, memory)
    (folder / "policy.pt2").write_bytes(memory.getvalue())
    write_onnx(
        program,
        example,
        folder / "policy.onnx",
        inputs=policy.input_names,
        outputs=policy.output_names,
    )
