"""Turns a policy into a file: its deterministic action, with normalization and recurrent state inside."""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from jaxtyping import Float
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn import functional
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.export.onnx_file import quiet, write_onnx
from ksim_rl.modules.action_heads import PARAMETERS, MixedHead
from ksim_rl.modules.network import ObservationNormalizer, side_by_side
from ksim_rl.modules.recurrent import RESET_KEY, RecurrentModule

# Greatest error of the ONNX file, and over how many observations it is looked for.
TOLERANCE = 1e-5
CHECKED = 10_000
# Observations in one call, as parallel episodes.
ROWS = 100


@dataclass(frozen=True, kw_only=True)
class StateSpec:
    """A state that the policy carries from step to step: an input [batch, *shape] and the output that feeds it next.

    An episode starts with zeros, or with its first frame, columns [start, stop) of the observation, in all places.
    """

    input: str
    output: str
    shape: tuple[int, ...]
    starts_with: Literal["zeros", "frame"]
    columns: tuple[int, int] | None = None


def _state(name: str, shape: tuple[int, ...], columns: tuple[int, int] | None = None) -> StateSpec:
    # A history begins with the first frame in all places, a recurrent state with zeros.
    starts_with = "frame" if columns else "zeros"
    return StateSpec(
        input=f"{name}_in",
        output=f"{name}_out",
        shape=shape,
        starts_with=starts_with,
        columns=columns,
    )


@dataclass(frozen=True, kw_only=True)
class Column:
    """One term that the policy reads: `size` numbers in a frame, of which `length` stand `stride` steps apart."""

    name: str
    size: int
    length: int = 1
    stride: int = 1


class ExportedPolicy(nn.Module):
    """A policy as a function of tensors: `obs` [batch, L] and its states to the actions [batch, A] and the next states.

    `obs` is the newest frame of every term, side by side; `groups` are the terms of each observation that the actor
    reads. Raises ValueError where the actor has a part that has no such form.
    """

    def __init__(
        self, actor: TensorDictModuleBase, groups: Mapping[NestedKey, Sequence[Column]]
    ) -> None:
        super().__init__()
        self.actor = actor
        # The sequence of modules is run by hand in `forward`: exporters know no TensorDict.
        self.parts = list(_parts(actor))
        self.groups = groups
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
                self.states.append(_state(f"history_{column.name}", shape, columns))
            # Start of the next term in the frame.
            start += column.size
        self.obs_dim = start
        for part in self.parts:
            if isinstance(part, RecurrentModule):
                shape = (part.cfg.num_layers, part.cfg.hidden_dim)
                self.states += [_state(key[-1], shape) for key in part.state_keys]

    @property
    def columns(self) -> list[Column]:
        """The terms of a frame, in order."""
        return [column for columns in self.groups.values() for column in columns]

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs: "obs", then the states."""
        return ["obs", *(state.input for state in self.states)]

    @property
    def output_names(self) -> list[str]:
        """Names of the outputs: "actions", then the next states."""
        return ["actions", *(state.output for state in self.states)]

    def forward(
        self, obs_BL: Float[Tensor, "B L"], *states: Float[Tensor, "B *?S"]
    ) -> tuple[Float[Tensor, "B *?M"], ...]:
        """Return the actions and the next states."""
        # Consumed from the front, in the order of `states`: histories first, then recurrent ones.
        given = list(states)
        after = []
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
        return torch.cat([_row(action) for action in actions], -1), *after


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


def _row(action: Tensor) -> Tensor:
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
    example = (
        torch.zeros(2, policy.obs_dim),
        *(torch.zeros(2, *state.shape) for state in policy.states),
    )
    batch = torch.export.Dim("batch", min=1, max=2**20)
    # One entry per parameter of `forward`; the states are one parameter, a tuple.
    shapes: tuple[Any, ...] = ({0: batch}, tuple({0: batch} for _ in policy.states))
    # No gradients; warnings of the exporter are not for users.
    with torch.no_grad(), quiet():
        program = torch.export.export(
            policy, example, dynamic_shapes=shapes if policy.states else shapes[:1]
        )
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


def greatest_difference(policy: ExportedPolicy, path: Path) -> float:
    """Return the greatest difference of an ONNX file's actions from the actor's, over `CHECKED` observations.

    It is relative to actions above 1, which float32 holds no better.
    They are drawn about the statistics of the policy's normalizer, in episodes of 100 steps that carry the states. The
    actor itself is asked through TensorDicts, with histories put together here.
    """
    import onnxruntime  # an extra

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    draws = np.random.default_rng(0)
    worst = 0.0
    mean, std = _statistics(policy)
    carried: dict[NestedKey, Tensor] = {}
    states: list[np.ndarray] = []
    frames: list[np.ndarray] = []
    # Batches of ROWS make CHECKED observations; each batch is one step of all episodes.
    for step in range(CHECKED // ROWS):
        frames.append(
            (mean + std * draws.standard_normal((ROWS, policy.obs_dim))).astype(np.float32)
        )
        # States begin with the first frame, as they do on a robot.
        if not step:
            states = [_first(state, frames[0]) for state in policy.states]
        feed = dict(zip(policy.input_names, [frames[-1], *states], strict=True))
        actions, *states = (np.asarray(value) for value in session.run(policy.output_names, feed))
        # Recurrent modules clear their state where this is true, at the first step.
        asked = TensorDict({RESET_KEY: torch.full((ROWS, 1), not step)}, batch_size=[ROWS])
        start = 0
        for group, columns in policy.groups.items():
            # Histories are put together from the kept frames, not taken from the states under test.
            terms = []
            for column in columns:
                back = [column.stride * k for k in reversed(range(column.length))]
                terms += [frames[max(step - k, 0)][:, start : start + column.size] for k in back]
                start += column.size
            asked[group] = torch.from_numpy(np.concatenate(terms, -1))
        # The recurrent state that the actor gave at the step before, zeros at first.
        for part in policy.parts:
            if isinstance(part, RecurrentModule):
                zeros = torch.zeros(ROWS, part.cfg.num_layers, part.cfg.hidden_dim)
                for key in part.state_keys:
                    asked[key] = carried.get(key, zeros)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            answer = policy.actor(asked)
        # TorchRL's modules give the state of the next step under "next".
        carried = {
            key: answer["next", *key]
            for part in policy.parts
            for key in getattr(part, "state_keys", ())
        }
        wanted = torch.cat([_row(answer[key]) for key in policy.action_keys], -1).numpy()
        # Also where one of the two is NaN, which numpy's `max` passes on, and Python's may not.
        difference = (np.abs(actions - wanted) / np.maximum(np.abs(wanted), 1.0)).max()
        worst = max(worst, float("inf") if np.isnan(difference) else float(difference))
    return worst


def _statistics(policy: ExportedPolicy) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and std of one frame, [L] each; 0 and 1 without a normalizer that covers it."""
    mean = np.zeros(policy.obs_dim)
    std = np.ones(policy.obs_dim)
    for module in policy.actor.modules():
        whole = sum(column.size * column.length for column in policy.columns)
        # The normalizer that covers the whole observation, histories included.
        if isinstance(module, ObservationNormalizer) and module.dim == whole:
            newest = []
            stop = 0
            for column in policy.columns:
                stop += column.size * column.length
                newest += range(stop - column.size, stop)
            mean_L = module.mean.detach().cpu().double()
            std_L = module.var.detach().cpu().double().sqrt()
            mean = mean_L.numpy()[newest]
            # A column that never moved has no spread; it is drawn a little about its mean.
            std = std_L.clamp(min=1e-3).numpy()[newest]
    return mean, std


def _first(state: StateSpec, frame: np.ndarray) -> np.ndarray:
    if state.columns is None:
        return np.zeros((len(frame), *state.shape), np.float32)
    return np.repeat(frame[:, None, slice(*state.columns)], state.shape[0], 1)
