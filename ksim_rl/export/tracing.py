"""Traces terms over a robot's measurements, so that they are written once, in torch, and run elsewhere as ONNX.

Each term runs once while torch's operations are written down. What it reads of the view by name becomes an input (see
`measurements`), what it keeps in `view.buffer` a pair of an input and an output, and a table a constant.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import getitem
from pathlib import Path
from typing import TypeAlias

import torch
from jaxtyping import Shaped
from torch import Tensor, fx, nn
from torch.utils._pytree import PyTree, tree_map_only

from ksim_rl.device.recording import Operation, recorded
from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.term_checks.term_memory import (
    COMPUTED,
    DIFFICULTY,
    FIELD,
    INPUT,
    MOCAP,
    MODEL,
    PARAMETER,
    QUANTITY,
    STATE,
    TABLE,
    Piece,
    TermMemory,
)
from ksim_rl.envs.view import EnvView
from ksim_rl.export.measurements import Measurement, forget_others, measurements, seen_by_rays
from ksim_rl.export.onnx_file import quiet, write_onnx
from ksim_rl.export.refusal import NotDescribedError
from ksim_rl.export.standalone.files import Json
from ksim_rl.scene.state.buffers import ENV

# A term, as it is called.
Called: TypeAlias = Callable[[EnvView], Shaped[Tensor, " E *leaf"]]
# Where a tensor lies, and how it is read there: two tensors with the same key are the same numbers.
Key: TypeAlias = tuple[int, int, torch.Size, tuple[int, ...], torch.dtype]
# Why a term cannot read a piece of memory in an export, by its owner.
_NOT_MEASURED = {
    FIELD: "a field of the model that differs between worlds",
    STATE: "a state of the physics that no export names",
    COMPUTED: "a result of the physics that no export names",
    INPUT: "an input of the physics",
    MOCAP: "the pose of a body that is moved by hand",
    PARAMETER: "a value that events and actions write",
    QUANTITY: "a quantity that no export names",
    ENV: "what the env keeps for itself",
}


def key_of(tensor: Shaped[Tensor, "*shape"]) -> Key:
    """Return where a tensor lies in memory."""
    start = tensor.untyped_storage().data_ptr()
    return start, int(tensor.storage_offset()), tensor.shape, tensor.stride(), tensor.dtype


@dataclass(frozen=True, kw_only=True)
class TracedInput:
    """An input of a graph: its name, and the measurement that fills it."""

    name: str
    measurement: Measurement


@dataclass(frozen=True, kw_only=True)
class TracedState:
    """The memory of a term from step to step: an input, zeros in a new episode, and the output that feeds it next."""

    input: str
    output: str
    example: Shaped[Tensor, "*shape"]


@dataclass(frozen=True, kw_only=True)
class Traced:
    """Terms as a function of tensors: the inputs, then the states, to the values of all terms, then the next states.

    `module` takes and gives a row per env of the env that was traced. `reads` are the inputs of each term, by scope.
    """

    module: fx.GraphModule
    output: str
    inputs: Sequence[TracedInput]
    states: Sequence[TracedState]
    reads: Mapping[str, Sequence[str]]

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs, in order."""
        measured = [one.name for one in self.inputs]
        return measured + [state.input for state in self.states]

    @property
    def output_names(self) -> list[str]:
        """Names of the outputs, in order."""
        return [self.output, *(state.output for state in self.states)]

    @property
    def examples(self) -> tuple[Shaped[Tensor, "*?shape"], ...]:
        """A tensor for each input."""
        return (
            *(one.measurement.value.detach().clone() for one in self.inputs),
            *(state.example for state in self.states),
        )

    def write(self, path: Path) -> None:
        """Write the graph as ONNX, for one robot; the env that was traced must have had a single row, on the CPU."""
        module = self.module.eval()
        with torch.no_grad(), quiet():
            program = torch.export.export(module, self.examples)
        write_onnx(program, self.examples, path, inputs=self.input_names, outputs=self.output_names)

    def described(self) -> Json:
        """Return the entry of `export.json`: which quantity fills which input, and which outputs feed which states."""
        return {
            "output": self.output,
            "measurements": [{"input": one.name, **one.measurement.node} for one in self.inputs],
            "states": [{"input": state.input, "output": state.output} for state in self.states],
        }


def trace(env: ManagerBasedRlEnv, terms: Sequence[tuple[str, Called]], *, output: str) -> Traced:
    """Trace terms of an env, each with its scope, such as "rewards/upright"; `output` are their values side by side.

    Terms of one value per env give one column, and one that is given twice is read once. Nothing of the env changes.
    Raises NotDescribedError, naming the term's class and what it reads or does, for one that depends on anything that
    neither a robot nor another simulator knows.
    """
    tracer = _Tracer(env)
    columns = []
    for scope, term in terms:
        try:
            columns.append(tracer.add(scope, term))
        except NotDescribedError as error:
            raise NotDescribedError(f"{type(term).__name__} {error}") from None
    return tracer.traced(columns, output)


class _Tracer:
    """A graph that grows by a term at a time."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._driver = env.driver
        self._view = env.view
        self._memory = TermMemory(env.driver, env.driver.readings, env.view)
        self._root = nn.Module()
        self._graph = fx.Graph()
        # Two nodes that are erased at the end: measurements stand before the first, states before the second.
        self._end_of_inputs = self._graph.call_function(torch.zeros, ((),))
        self._end_of_states = self._graph.call_function(torch.zeros, ((),))
        self._nodes: dict[Key, fx.Node] = {}
        self._measured: dict[Key, Measurement] = {}
        self._given: dict[Key, tuple[TracedInput, fx.Node]] = {}
        self._states: list[tuple[TracedState, fx.Node]] = []
        self._columns: dict[str, fx.Node] = {}
        self._reads: dict[str, list[str]] = {}
        self._counted: dict[str, int] = {}
        self._scope = ""
        # Tensors stay alive, so that no memory is used twice.
        self._alive: list[Tensor | Operation] = []

    # -- running terms -------------------------------------------------------------------------------------------

    def add(self, scope: str, term: Called) -> fx.Node:
        """Add a term, and return the node of its value, float32 [E, L]."""
        if scope in self._columns:
            return self._columns[scope]
        forget_others(self._view)
        before = self._states_of(scope)
        try:
            # Once to see which quantities it reads, which then are there when it is recorded.
            self._run(scope, term)
            for sensor in seen_by_rays(self._view):
                raise NotDescribedError(f"reads {sensor}, which an export has not")
            forget_others(self._view)
            with recorded() as recorder:
                value = self._run(scope, term)
        except RuntimeError as error:
            raise NotDescribedError(f"cannot be traced: {error}") from error
        finally:
            # Before anything else runs: the term's own memory is as it was.
            for buffer, old in before:
                buffer.copy_(old)
        self._measured = {}
        for one in measurements(self._view):
            # The first name stays: all joints in their order may be the same memory as the whole state.
            self._measured.setdefault(key_of(one.value), one)
        self._scope = scope
        self._reads[scope] = []
        for entry in recorder.entries:
            if not isinstance(entry, Operation):
                raise NotDescribedError("launches a kernel of its own, which an export has not")
            self._add_operation(entry)
        node = self._node(value)
        if value.dtype != torch.float32:
            node = self._call(torch.ops.aten._to_copy.default, (node,), {"dtype": torch.float32})
        column = self._call(torch.ops.aten.reshape.default, (node, [len(value), -1]), {})
        self._columns[scope] = column
        return column

    def _run(self, scope: str, term: Called) -> Tensor:
        with torch.no_grad(), self._driver.scope(scope):
            return term(self._view)

    def _states_of(self, scope: str) -> list[tuple[Tensor, Tensor]]:
        """Return the memory of a term, and copies."""
        return [
            (piece.tensor, piece.tensor.clone())
            for piece in self._memory.lasting()
            if piece.owner == scope and piece.tensor is not None
        ]

    # -- the graph -----------------------------------------------------------------------------------------------

    def _call(
        self, function: torch._ops.OpOverload, args: tuple[PyTree, ...], kwargs: PyTree
    ) -> fx.Node:
        return self._graph.call_function(function, args, kwargs)

    def _add_operation(self, operation: Operation) -> None:
        if operation.name == "draw":
            raise NotDescribedError("draws random numbers")
        if operation.function.namespace != "aten":
            raise NotDescribedError(
                f"uses the operator {operation.function}, which an export has not"
            )
        for tensor in operation.written:
            self._check_written(tensor)
        args = tree_map_only(Tensor, self._node, operation.args)
        kwargs = tree_map_only(Tensor, self._node, operation.kwargs)
        node = self._call(operation.function, args, kwargs)
        self._alive.append(operation)
        returns = operation.function._schema.returns
        is_one = len(returns) == 1 and returns[0].type.kind() == "TensorType"
        for place, tensor in enumerate(operation.made):
            # An operator that gives several tensors gives a tuple of them.
            self._nodes[key_of(tensor)] = (
                node if is_one else self._graph.call_function(getitem, (node, place))
            )

    def _check_written(self, tensor: Tensor) -> None:
        """Refuse a write into memory that is neither made by the term nor its own buffer."""
        if key_of(tensor) in self._nodes or self._made_here(tensor):
            return
        piece = self._memory.holder(tensor)
        if piece is None or piece.owner != self._scope:
            raise NotDescribedError(
                "keeps what changes in a tensor of its own: keep it in `view.buffer`, which an export knows"
            )

    def _made_here(self, tensor: Tensor) -> bool:
        start = tensor.untyped_storage().data_ptr()
        return any(key[0] == start for key in self._nodes)

    def _node(self, tensor: Tensor) -> fx.Node:
        """Return the node of a tensor that a term has read."""
        key = key_of(tensor)
        if key in self._measured:
            return self._input(self._measured[key])
        if key in self._nodes:
            return self._nodes[key]
        piece = self._memory.holder(tensor)
        if piece is not None and piece.owner == self._scope:
            return self._state(piece, tensor)
        self._check_constant(piece)
        name = f"constant_{self._numbered('constant')}"
        self._root.register_buffer(name, tensor.detach().clone())
        # Remembered, as the same table is read by many terms; and alive, so that its memory is used for nothing else.
        self._nodes[key] = self._graph.get_attr(name)
        self._alive.append(tensor)
        return self._nodes[key]

    def _check_constant(self, piece: Piece | None) -> None:
        """Refuse memory that changes, and whose numbers now would be a constant of the graph."""
        # Memory that the view does not give is the term's own: the weights of a network, a table.
        if piece is None or piece.owner in (MODEL, DIFFICULTY):
            return
        if piece.name in ("view.seed", "view.step_count", "view.reset_count_E"):
            raise NotDescribedError(f"reads {piece.name}, which goes on beyond an episode")
        # A table has no row per env: limits, poses, indices. The table of flat ground is zero everywhere.
        is_flat = piece.name.startswith("view.terrain.") and self._view.terrain.is_flat
        if piece.owner == TABLE and (is_flat or not re.search(r"_E\w*$", piece.name)):
            return
        about = _NOT_MEASURED.get(piece.owner, "what the terrain or another part of the env keeps")
        raise NotDescribedError(
            f"reads {piece.name}, {about}: read a quantity of the view that a robot can measure, or put the term into "
            "a group of observations that the policy does not read"
        )

    def _input(self, measurement: Measurement) -> fx.Node:
        """Return the node of a measurement."""
        key = key_of(measurement.value)
        if key not in self._given:
            name = self._named(measurement.node)
            node = self._placeholder(name, before=self._end_of_inputs)
            self._given[key] = (TracedInput(name=name, measurement=measurement), node)
            self._alive.append(measurement.value)
        found, node = self._given[key]
        if found.name not in self._reads[self._scope]:
            self._reads[self._scope].append(found.name)
        return node

    def _state(self, piece: Piece, tensor: Tensor) -> fx.Node:
        """Return the node of the term's memory, as it is when the term has run up to here."""
        buffers = self._driver.buffers
        name = next((name for name, one in buffers.by_name().items() if one is piece.tensor), "")
        if not name or buffers.is_kept(name):
            raise NotDescribedError(
                f"keeps {piece.name} beyond an episode or for all envs together: an export forgets at each reset"
            )
        if piece.tensor is None or key_of(piece.tensor) != key_of(tensor):
            raise NotDescribedError(
                f"reads a part of {piece.name} that it took earlier: ask `view.buffer` each time"
            )
        called = re.sub(r"\W+", "_", name)
        given = self._placeholder(f"{called}_in", before=self._end_of_states)
        # A copy, which the term's writes in place change: inputs stay as they are.
        node = self._call(torch.ops.aten.clone.default, (given,), {})
        state = TracedState(
            input=f"{called}_in", output=f"{called}_out", example=torch.zeros_like(tensor)
        )
        self._states.append((state, node))
        self._nodes[key_of(tensor)] = node
        self._alive.append(tensor)
        return node

    def _placeholder(self, name: str, *, before: fx.Node) -> fx.Node:
        with self._graph.inserting_before(before):
            return self._graph.placeholder(name)

    def _named(self, node: Json) -> str:
        """Return a new name for an input, which says what it is."""
        words = [
            node["quantity"],
            *(node[word] for word in ("sensor", "command", "field") if word in node),
        ]
        if node.get("frame") == "world":
            words.append("world")
        name = re.sub(r"\W+", "_", "_".join(words))
        number = self._numbered(name)
        return name if number == 0 else f"{name}_{number + 1}"

    def _numbered(self, name: str) -> int:
        """Return how often a name was asked for before."""
        self._counted[name] = self._counted.get(name, -1) + 1
        return self._counted[name]

    def traced(self, columns: Sequence[fx.Node], output: str) -> Traced:
        """Return the graph, whose first output are the values of the terms side by side."""
        values = self._call(torch.ops.aten.cat.default, (list(columns), 1), {})
        self._graph.output((values, *(node for _, node in self._states)))
        for marker in (self._end_of_inputs, self._end_of_states):
            self._graph.erase_node(marker)
        self._graph.lint()
        return Traced(
            module=fx.GraphModule(self._root, self._graph),
            output=output,
            inputs=[found for found, _ in self._given.values()],
            states=[state for state, _ in self._states],
            reads=self._reads,
        )
