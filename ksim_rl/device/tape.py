"""This module makes few kernels of what torch computes for the rows of a batch: code of any shape, once it has run.

A run of a function is written down operation by operation, as torch dispatches them, with the launches of Warp in
between. Operations that keep to their row, one after the other, become one kernel with a thread per row, in C++ of
`row_code`; what lives in one kernel only is in that thread's own memory. Other operations are run by torch as they
were. A replay uses the memory of the recording and runs no Python of the function, as a CUDA graph does, and what is
fit for that is fit for this.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
import warp as wp
from jaxtyping import Shaped
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

MOST_SHARED = 256
"""Numbers without rows that each thread may work out for itself."""
MOST_OPERATIONS = 200
_HOST_READS = frozenset({"_local_scalar_dense", "equal", "item", "masked_select", "nonzero"})
_COUNTS = frozenset({"count_non_finite"})  # all rows write to the same numbers, in an order that does not matter


class _Recording(threading.local):
    recorder: "Recorder | None" = None


_recording = _Recording()


def is_recording() -> bool:
    """Whether this thread writes down what torch computes: then every kernel has to be an operator of torch."""
    return _recording.recorder is not None


def launched(launch: Callable[[], None]) -> bool:
    """Make a launch of Warp part of the recording, and say so; without a recording, do nothing."""
    recorder = _recording.recorder
    if recorder is None:
        return False
    with recorder.paused():
        launch()
    recorder.entries.append(launch)
    return True


@dataclass(frozen=True, eq=False)
class Operation:
    """One call of an operator, the tensors that it made, and those that it wrote."""

    function: Any
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    made: list[Tensor]
    written: list[Tensor]

    @property
    def name(self) -> str:
        """What the operator is called, whatever its arguments are."""
        return self.function.overloadpacket.__name__

    def read(self) -> list[Tensor]:
        """Return the tensors among the arguments."""
        return _tensors((self.args, self.kwargs))

    def __call__(self) -> None:
        """Do it once more, in the same memory."""
        result = self.function(*self.args, **self.kwargs)
        if self.made:
            again = [new for new in _tensors(result) if all(new is not old for old in self.written)]
            for old, new in zip(self.made, again, strict=True):
                old.copy_(new)


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


class Recorder(TorchDispatchMode):
    """Writes down operations as they are dispatched; tensors stay alive, so that no memory is used twice."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[Operation | Callable[[], None]] = []

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Write nothing down in this block."""
        _recording.recorder = None
        try:
            with torch.utils._python_dispatch._disable_current_modes():
                yield
        finally:
            _recording.recorder = self

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func.overloadpacket.__name__ in _HOST_READS:
            raise RuntimeError(f"{func} reads the device on the host")
        _recording.recorder = None
        try:
            result = func(*args, **kwargs)
        finally:
            _recording.recorder = self
        read = {id(tensor) for tensor in _tensors((args, kwargs))}
        made = [tensor for tensor in _tensors(result) if id(tensor) not in read]
        written = list(_written(func, args, kwargs))
        if made or written:
            self.entries.append(Operation(func, args, kwargs, made, written))
        return result


def _written(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Iterator[Tensor]:
    for place, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            yield from _tensors(args[place] if place < len(args) else kwargs.get(argument.name))


@contextmanager
def recorded() -> Iterator[Recorder]:
    """Write down what torch computes in this block, and what Warp launches."""
    assert _recording.recorder is None, "recordings do not nest"
    recorder = _recording.recorder = Recorder()
    try:
        with recorder:
            yield recorder
    finally:
        _recording.recorder = None


def _storage(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _extent(tensor: Tensor) -> tuple[int, int]:
    """Return the address of a tensor's first number, and the one behind the last."""
    last = sum((size - 1) * stride for size, stride in zip(tensor.shape, tensor.stride(), strict=True))
    return tensor.data_ptr(), tensor.data_ptr() + (last + 1) * tensor.element_size()


def _starts(tensors: Sequence[Tensor]) -> dict[tuple[int, int], int]:
    """Return where the memory begins that each extent is part of: extents that overlap are one piece."""
    starts: dict[tuple[int, int], int] = {}
    start, end = 0, 0
    for first, last in sorted({_extent(tensor) for tensor in tensors}):
        start = first if first >= end else start
        end = max(end, last)
        starts[first, last] = start
    return starts


@dataclass(eq=False)
class _Kernel:
    """Operations that run as one, and how each piece of memory is used: the distance of its rows, 0 without rows."""

    operations: list[Operation] = field(default_factory=list)
    rows: list[int] = field(default_factory=list)
    distances: dict[int, set[int]] = field(default_factory=dict)
    written: set[int] = field(default_factory=set)
    made: set[int] = field(default_factory=set)
    counted: set[int] = field(default_factory=set)
    launch: Callable[[], None] | None = None

    def fits(self, distances: dict[int, set[int]], written: set[int], counted: set[int]) -> bool:
        """Whether an operation may follow in the same kernel: no row may see what another one writes."""
        if len(self.operations) >= MOST_OPERATIONS:
            return False
        for place, own in distances.items():
            is_written = place in self.written or place in written
            if is_written and len(own | self.distances.get(place, set())) > 1:
                return False
        return self.counted.isdisjoint(distances.keys() - counted) and counted.isdisjoint(
            self.distances.keys() - self.counted
        )


class Tape:
    """A recorded function of the rows of a batch as kernels and launches.

    Call it to run them: it reads and writes the memory of the recording, what was returned included. `num_rows` is E,
    and `returned` what is used afterwards.
    """

    def __init__(self, recorder: Recorder, *, num_rows: int, returned: Sequence[Shaped[Tensor, "*shape"]]) -> None:
        self._num_rows = num_rows
        self._roots: dict[int, Tensor] = {}  # the first tensor of each piece of memory that the recording made
        for entry in recorder.entries:
            if isinstance(entry, Operation):
                before = {_storage(tensor) for tensor in entry.read()}
                for tensor in entry.made:
                    if tensor.numel() and _storage(tensor) not in before:
                        self._roots.setdefault(_storage(tensor), tensor)
        operations = [entry for entry in recorder.entries if isinstance(entry, Operation)]
        used = [tensor for one in operations for tensor in (*one.read(), *one.made) if tensor.numel()]
        self._starts = _starts([tensor for tensor in used if _storage(tensor) not in self._roots])
        self.parts: list[_Kernel | Callable[[], None]] = []
        self._device = next(iter(returned)).device
        for entry in recorder.entries:
            if not isinstance(entry, Operation):
                self.parts.append(entry)
            elif any(tensor.device != self._device for tensor in entry.made):
                continue  # a number that the host gave
            elif entry.written or any(self._roots.get(self._place(tensor)) is tensor for tensor in entry.made):
                self._add(entry)
        self._own = self._find_own(returned)
        self._kept = [tensor for place, tensor in self._roots.items() if place not in self._own]
        for part in self.parts:
            if isinstance(part, _Kernel):
                part.launch = self._compiled(part)
                part.operations.clear()

    @property
    def num_kernels(self) -> int:
        """How many of the parts are kernels of rows."""
        return sum(isinstance(part, _Kernel) for part in self.parts)

    def __call__(self) -> None:
        """Run all parts in order."""
        for part in self.parts:
            launch = part.launch if isinstance(part, _Kernel) else part
            assert launch is not None
            launch()

    def _place(self, tensor: Tensor) -> int:
        """Return where the piece of memory begins that a tensor is part of: one storage may hold many."""
        storage = _storage(tensor)
        return storage if storage in self._roots or not tensor.numel() else self._starts[_extent(tensor)]

    def _add(self, operation: Operation) -> None:
        """Put an operation into the kernel that comes last, or into a new one, or leave it to torch."""
        rows = self._rows_of(operation)
        try:
            distances = self._distances(operation, rows)
        except row_code.NotARowError:
            self.parts.append(operation)
            return
        written = {self._place(tensor) for tensor in (*operation.written, *operation.made)}
        counted = written if operation.name in _COUNTS else set()
        last = self.parts[-1] if self.parts else None
        kernel = last if isinstance(last, _Kernel) and last.fits(distances, written - counted, counted) else _Kernel()
        lone = {self._place(tensor) for tensor in operation.written if 0 in distances[self._place(tensor)]} - counted
        if lone - kernel.made:
            self.parts.append(operation)  # all rows would write numbers that were there before
            return
        if kernel is not last:
            self.parts.append(kernel)
        kernel.made |= {self._place(tensor) for tensor in operation.made}
        kernel.operations.append(operation)
        kernel.rows.append(rows)
        for place, own in distances.items():
            kernel.distances.setdefault(place, set()).update(own)
        kernel.written |= written - counted
        kernel.counted |= counted

    def _rows_of(self, operation: Operation) -> int:
        if operation.name in _COUNTS:
            return self._num_rows
        first = (*operation.made, *operation.written)[0]
        return self._num_rows if first.ndim and first.shape[0] == self._num_rows else 0

    def _distances(self, operation: Operation, rows: int) -> dict[int, set[int]]:
        """Return how an operation uses memory; a NotARowError where it does not keep to its row."""
        cells = row_code.Cells(rows=rows, address=lambda _: ("", 0, True), device=self._device)
        outs = [*operation.made, *operation.written]
        if len(outs) > 1 and operation.name not in _COUNTS:
            raise row_code.NotARowError("several results")
        row_code.lines(operation.function, operation.args, operation.kwargs, outs, cells)
        distances: dict[int, set[int]] = {}
        for tensor, distance in cells.seen:
            root = self._roots.get(self._place(tensor))
            if root is not None and root.dtype != tensor.dtype:
                raise row_code.NotARowError("memory of two types")
            if distance == 0 and tensor.numel() > MOST_SHARED and not rows:
                raise row_code.NotARowError("many numbers without rows")
            distances.setdefault(self._place(tensor), set()).add(distance)
        if rows and operation.name not in _COUNTS and any(0 in distances[self._place(tensor)] for tensor in outs):
            raise row_code.NotARowError("all rows write the same numbers")
        return distances

    def _find_own(self, returned: Sequence[Tensor]) -> dict[int, _Kernel]:
        """Return the memory that one kernel alone uses, which need not exist outside of it."""
        users: dict[int, set[int]] = {}
        for number, part in enumerate(self.parts):
            operations = part.operations if isinstance(part, _Kernel) else [part]
            for operation in operations:
                if isinstance(operation, Operation):
                    for tensor in (*operation.read(), *operation.made):
                        users.setdefault(self._place(tensor), set()).add(number)
        outside = {self._place(tensor) for tensor in returned}
        own: dict[int, _Kernel] = {}
        for place, root in self._roots.items():
            numbers = users.get(place, set())
            kernel = self.parts[min(numbers)] if len(numbers) == 1 else None
            if isinstance(kernel, _Kernel) and place not in outside and self._is_simple(root, kernel, place):
                own[place] = kernel
        return own

    def _is_simple(self, root: Tensor, kernel: _Kernel, place: int) -> bool:
        distances = kernel.distances.get(place, {0})
        width = root.untyped_storage().nbytes() // root.element_size()
        if distances == {0}:
            return width <= MOST_SHARED
        return distances == {width // self._num_rows} and width % self._num_rows == 0

    def _compiled(self, kernel: _Kernel) -> Callable[[], None]:
        names: dict[int, str] = {}
        outside: dict[int, Tensor] = {}
        arrays: list[str] = []
        ends: list[str] = []

        def address(tensor: Tensor) -> tuple[str, int, bool]:
            place, root = self._place(tensor), self._roots.get(_storage(tensor))
            shared = root is not None and kernel.distances.get(place) == {0} and place in kernel.written
            is_own = self._own.get(place) is kernel
            if place not in names:
                names[place] = f"m{len(names)}"
                ctype = row_code.CTYPES[tensor.dtype]
                if is_own or shared:
                    assert root is not None
                    width = root.untyped_storage().nbytes() // root.element_size()
                    width //= 1 if shared or kernel.distances.get(place) == {0} else self._num_rows
                    arrays.append(f"{ctype} {names[place]}[{width}];")
                    if not is_own:
                        # All rows work it out, and one hands it on.
                        outside[place] = tensor
                        copy = f"(({ctype}*)a.{names[place]})[i] = {names[place]}[i];"
                        ends.append(f"if (row == 0) for (int i = 0; i < {width}; ++i) {copy}")
                else:
                    outside[place] = tensor
                    arrays.append(f"{ctype}* {names[place]} = ({ctype}*)a.{names[place]};")
            offset = (tensor.data_ptr() - place) // tensor.element_size()
            return names[place], offset, not (is_own or shared)

        body: list[str] = []
        for operation, rows in zip(kernel.operations, kernel.rows, strict=True):
            cells = row_code.Cells(rows=rows, address=address, device=self._device)
            outs = [*operation.made, *operation.written]
            body += row_code.lines(operation.function, operation.args, operation.kwargs, outs, cells)
        draws = [random.DRAWS] if any("key_of" in line for line in body) else []
        source = "\n".join([*draws, row_code.PRELUDE, *arrays, *body, *ends])
        fields = " ".join(names[place] for place in outside)
        launch = quick_launch.QuickLaunch(
            quick_launch.arguments_of((wp.uint64, fields)), source, indices=("row", "lane"), block_dim=32
        )
        addresses = tuple(outside)
        self._kept += outside.values()
        dim = (self._num_rows, 1)
        return lambda: launch(self._device, dim, *addresses)


# At the end, since these ask whether something is being recorded.
from ksim_rl.device import quick_launch, random, row_code  # noqa: E402
