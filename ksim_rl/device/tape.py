"""This module compiles what torch computes between launches of Warp: code of any shape, once it has run.

A run of a function is written down operation by operation, as torch dispatches them, with the launches of Warp in
between. Each stretch without a launch becomes one compiled function, in which hundreds of small kernels are few; a
replay calls these and issues the launches anew. Python is not run again, as in a replay of a CUDA graph, and what is
fit for that is fit for this.
"""

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, fx
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map_only

Compiler = Callable[[fx.GraphModule, list[Tensor]], Callable[..., Sequence[Tensor]]]


def by_inductor(graph: fx.GraphModule, inputs: list[Tensor]) -> Callable[..., Sequence[Tensor]]:
    """Compile a stretch by Inductor; random numbers stay those of torch's generators, and equal runs have equal bits."""
    from torch import _inductor

    return _inductor.compile(graph, inputs, options={"deterministic": True, "fallback_random": True})


_HOST_READS = frozenset({"_local_scalar_dense", "item", "nonzero", "masked_select", "equal", "_unique2"})


class _Recording(threading.local):
    tape: "_Recorder | None" = None


_recording = _Recording()


def is_recording() -> bool:
    """Whether this thread writes down what torch computes: then every kernel has to be an operator of torch."""
    return _recording.tape is not None


def launched(launch: Callable[[], None]) -> bool:
    """Let a launch of Warp be part of the recording, and say so; without one, do nothing."""
    recorder = _recording.tape
    if recorder is None:
        return False
    with paused():
        launch()
    recorder.entries.append(launch)
    return True


@contextmanager
def paused() -> Iterator[None]:
    """Record nothing in this block."""
    recorder, _recording.tape = _recording.tape, None
    try:
        with _disable_current_modes():
            yield
    finally:
        _recording.tape = recorder


@dataclass(frozen=True, eq=False)
class _Operation:
    """One call of an operator, with the tensors that it read, wrote and made."""

    function: Any
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    made: list[Tensor]  # in place of a tensor that was written, None stands in `results`
    written: list[Tensor]
    result: Any

    def tensors(self) -> Iterator[Tensor]:
        return (leaf for leaf in tree_flatten((self.args, self.kwargs))[0] if isinstance(leaf, Tensor))


class _Recorder(TorchDispatchMode):
    """Writes down operations as they are dispatched; the tensors stay alive, so that addresses are not used again."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[_Operation | Callable[[], None]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func.overloadpacket.__name__ in _HOST_READS:
            raise RuntimeError(f"{func} reads the device on the host")
        recorder, _recording.tape = _recording.tape, None
        try:
            result = func(*args, **kwargs)
        finally:
            _recording.tape = recorder
        read = {id(leaf) for leaf in tree_flatten((args, kwargs))[0] if isinstance(leaf, Tensor)}
        made = [x for x in tree_flatten(result)[0] if isinstance(x, Tensor) and id(x) not in read]
        written = list(_written(func, args, kwargs))
        if made or written:
            self.entries.append(_Operation(func, args, kwargs, made, written, result))
        return result


def _written(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Iterator[Tensor]:
    for place, argument in enumerate(func._schema.arguments):
        if argument.alias_info is None or not argument.alias_info.is_write:
            continue
        given = args[place] if place < len(args) else kwargs.get(argument.name)
        yield from (leaf for leaf in tree_flatten(given)[0] if isinstance(leaf, Tensor))


@contextmanager
def recorded() -> Iterator[_Recorder]:
    assert _recording.tape is None, "recordings do not nest"
    recorder = _Recorder()
    _recording.tape = recorder
    try:
        with recorder:
            yield recorder
    finally:
        _recording.tape = None


# -- where tensors lie -------------------------------------------------------------------------------------------


def _extent(tensor: Tensor) -> tuple[int, int]:
    """Return the first address of a tensor's numbers and the one after the last."""
    last = sum((size - 1) * stride for size, stride in zip(tensor.shape, tensor.stride(), strict=True))
    first = tensor.data_ptr()
    return first, first + (last + 1) * tensor.element_size() if tensor.numel() else first


def _place(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


@dataclass(eq=False)
class _Stretch:
    """Operations between two launches: what they take from outside, and what later ones need of them."""

    operations: list[_Operation] = field(default_factory=list)
    inputs: list[Tensor] = field(default_factory=list)  # as they were when recorded
    outputs: list[Tensor] = field(default_factory=list)
    run: Callable[..., Sequence[Tensor]] | None = None
    graph: fx.GraphModule | None = None


class Tape:
    """A recorded function as compiled functions and launches: `tape(*inputs)` returns what it returned.

    `given` are the tensors that differ from call to call, in number and layout as recorded, and `returned` what the
    function gave. All others have to stay where they are.
    """

    def __init__(
        self, recorder: _Recorder, *, given: Sequence[Tensor], returned: Sequence[Tensor], compiler: Compiler
    ) -> None:
        self._parts: list[_Stretch | Callable[[], None]] = []
        for entry in recorder.entries:
            if isinstance(entry, _Operation):
                if not self._parts or not isinstance(self._parts[-1], _Stretch):
                    self._parts.append(_Stretch())
                self._parts[-1].operations.append(entry)
            else:
                self._parts.append(entry)
        self._given, self._returned = list(given), list(returned)
        # The first tensor of each piece of memory that was made while recording; others are views of it.
        self._roots: dict[int, Tensor] = {}
        self._made_in: dict[int, _Stretch] = {}
        for stretch in self.stretches:
            for operation in stretch.operations:
                before = {_place(tensor) for tensor in operation.tensors()}
                for tensor in operation.made:
                    if _place(tensor) not in before and _place(tensor) not in self._roots:
                        self._roots[_place(tensor)] = tensor
                        self._made_in[_place(tensor)] = stretch
        self._find_outputs()
        for stretch in self.stretches:
            self._build(stretch, compiler)
        for stretch in self.stretches:
            stretch.operations.clear()

    @property
    def stretches(self) -> list[_Stretch]:
        """What is compiled, in order."""
        return [part for part in self._parts if isinstance(part, _Stretch)]

    def _find_outputs(self) -> None:
        for stretch in self.stretches:
            for operation in stretch.operations:
                for tensor in operation.tensors():
                    self._need(tensor, stretch)
        for tensor in self._returned:
            self._need(tensor, None)

    def _need(self, tensor: Tensor, by: _Stretch | None) -> None:
        maker = self._made_in.get(_place(tensor)) if tensor.numel() else None
        if maker is not None and maker is not by:
            root = self._roots[_place(tensor)]
            if all(root is not known for known in maker.outputs):
                maker.outputs.append(root)

    def _build(self, stretch: _Stretch, compiler: Compiler) -> None:
        graph = fx.Graph()
        nodes: dict[int, fx.Node] = {}
        made = {id(tensor) for operation in stretch.operations for tensor in operation.made}
        own = {place for place, maker in self._made_in.items() if maker is stretch}
        outside: dict[int, Tensor] = {}
        written: list[tuple[int, int]] = []
        for operation in stretch.operations:
            for tensor in operation.tensors():
                if id(tensor) not in made:
                    outside.setdefault(id(tensor), tensor)
            written += [_extent(tensor) for tensor in operation.written if _place(tensor) not in own]
        for group in _overlapping(outside.values()):
            first, end = min(_extent(t)[0] for t in group), max(_extent(t)[1] for t in group)
            is_written = any(low < end and first < high for low, high in written)
            if len(group) == 1 or not is_written:
                for tensor in group:
                    nodes[id(tensor)] = _take(graph, stretch, tensor)
            else:
                base = _base(group)
                taken = _take(graph, stretch, base)
                for tensor in group:
                    nodes[id(tensor)] = _view_of(graph, taken, base, tensor)
        for operation in stretch.operations:
            _write(graph, nodes, operation)
        graph.output(tuple(nodes[id(tensor)] for tensor in stretch.outputs))
        stretch.graph = fx.GraphModule(torch.nn.Module(), graph)
        stretch.run = compiler(stretch.graph, [tensor.detach() for tensor in stretch.inputs])

    def __call__(self, *given: Tensor) -> list[Tensor]:
        """Replay with these tensors in the place of those that were given."""
        known: dict[int, Tensor] = {id(old): new for old, new in zip(self._given, given, strict=True)}
        for part in self._parts:
            if not isinstance(part, _Stretch):
                part()
                continue
            assert part.run is not None
            results = part.run(*[self._now(tensor, known) for tensor in part.inputs])
            for old, new in zip(part.outputs, results, strict=True):
                assert new.stride() == old.stride(), (old.stride(), new.stride())
                known[id(old)] = new
        return [self._now(tensor, known) for tensor in self._returned]

    def _now(self, tensor: Tensor, known: dict[int, Tensor]) -> Tensor:
        """Return what stands in a replay for a tensor of the recording."""
        if id(tensor) in known:
            return known[id(tensor)]
        root = self._roots.get(_place(tensor)) if tensor.numel() else None
        if root is None:
            return tensor
        offset = tensor.storage_offset() - root.storage_offset()
        now = known[id(root)]
        return now.as_strided(tensor.shape, tensor.stride(), now.storage_offset() + offset)


def _take(graph: fx.Graph, stretch: _Stretch, tensor: Tensor) -> fx.Node:
    stretch.inputs.append(tensor)
    return graph.placeholder(f"input_{len(stretch.inputs)}")


def _overlapping(tensors: Iterable[Tensor]) -> list[list[Tensor]]:
    """Return the tensors in groups that share memory."""
    groups: list[list[Tensor]] = []
    end = -1
    for tensor in sorted(tensors, key=lambda one: (_extent(one)[0], -_extent(one)[1])):
        first, last = _extent(tensor)
        if groups and first < end:
            groups[-1].append(tensor)
        else:
            groups.append([tensor])
        end = max(end, last)
    return groups


def _base(group: list[Tensor]) -> Tensor:
    """Return a tensor that holds all the numbers of a group in order, in the same memory."""
    first, end = _extent(group[0])[0], max(_extent(tensor)[1] for tensor in group)
    size = group[0].element_size()
    if len({tensor.dtype for tensor in group}) > 1:
        raise RuntimeError("memory that changes is read as two dtypes")
    for tensor in group:
        storage = tensor.untyped_storage()
        if storage.data_ptr() <= first and end <= storage.data_ptr() + storage.nbytes():
            whole = tensor.is_contiguous() and _extent(tensor) == (first, end)
            if whole:
                return tensor
            offset, length = (first - storage.data_ptr()) // size, (end - first) // size
            return torch.empty(0, dtype=tensor.dtype, device=tensor.device).set_(
                storage, offset, (length,), (1,)
            )
    raise RuntimeError("memory that changes is shared by arrays that lie side by side")


def _view_of(graph: fx.Graph, node: fx.Node, base: Tensor, tensor: Tensor) -> fx.Node:
    """Return `tensor` as a view of a base of the same memory."""
    if tensor is base:
        return node
    offset = (tensor.data_ptr() - base.data_ptr()) // base.element_size()
    aten = torch.ops.aten
    # A column, or columns: what the compiler understands better than strides.
    if base.ndim == 2 and offset < base.shape[1]:
        if tensor.ndim == 1 and tensor.shape[0] == base.shape[0] and tensor.stride(0) == base.stride(0):
            return graph.call_function(aten.select.int, (node, 1, offset))
        if tensor.ndim == 2 and tensor.shape[0] == base.shape[0] and tensor.stride() == base.stride():
            return graph.call_function(aten.slice.Tensor, (node, 1, offset, offset + tensor.shape[1]))
    if base.ndim == 1 and tensor.ndim == 0:
        return graph.call_function(aten.select.int, (node, 0, offset))
    shape = list(tensor.shape), list(tensor.stride()), base.storage_offset() + offset
    return graph.call_function(aten.as_strided.default, (node, *shape))


def _write(graph: fx.Graph, nodes: dict[int, fx.Node], operation: _Operation) -> None:
    args, kwargs = tree_map_only(Tensor, lambda leaf: nodes[id(leaf)], (operation.args, operation.kwargs))
    if operation.function is torch.ops.aten.copy_.default:
        # The compiler takes a bare copy for the source itself, and reads that after it was written in its turn.
        is_bool = operation.args[1].dtype == torch.bool
        negated = torch.ops.aten.logical_not.default if is_bool else torch.ops.aten.neg.default
        twice = graph.call_function(negated, (graph.call_function(negated, (args[1],)),))
        args = (args[0], twice, *args[2:])
    node = graph.call_function(operation.function, args, kwargs)

    def name(value: Any, node: fx.Node) -> None:
        if isinstance(value, Tensor):
            nodes.setdefault(id(value), node)
        elif isinstance(value, (tuple, list)):
            for place, part in enumerate(value):
                if isinstance(part, Tensor) and id(part) in nodes:
                    continue
                name(part, graph.call_function(_item, (node, place)))

    name(operation.result, node)


def _item(values: Sequence[Any], place: int) -> Any:
    return values[place]
