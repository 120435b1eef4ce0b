"""Fuses recorded torch operations that act per env into a few kernels.

Consecutive operations that keep to their row become one kernel, in C++ of `row_code`, with a thread per row or a few
`lanes`; tensors that only one kernel uses become arrays of a row's own. Torch runs the other operations as they were,
and Warp's launches are issued again. Like a CUDA graph, a replay uses the memory of the recording and runs no Python
of the function, so a function that can be captured can be recorded here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
import warp as wp
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.compiled import row_code
from ksim_rl.compiled.cells import CTYPES, Cells, Element, Loop, NotARowError
from ksim_rl.compiled.lanes import BLOCK, DEAL, LANES, SHARED, Own, Work, schedule, source
from ksim_rl.device import headers, kernel_loading
from ksim_rl.device.extents import extent
from ksim_rl.device.quick_launch import ADDRESS, QuickLaunch, arguments_of
from ksim_rl.device.recording import Operation, Recorder

MOST_SHARED = 256
"""At most so many numbers without rows are computed by each thread for itself."""
MOST_OPERATIONS = 200
"""At most so many operations in one kernel; its compilation takes longer the more there are."""
MOST_BYTES = 40_000
"""Shared memory of a block for the arrays of its rows; a kernel that needs more gets one thread per row."""
_FUNCTIONS = headers.text_of("ksim_rl/compiled/row_formulas.cuh")
# All rows add to the same numbers, in an order that does not matter.
_COUNTS = frozenset({"count_non_finite"})


def _storage(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


@dataclass(eq=False)
class _Memory:
    """Pieces of memory by first address: storages made in a recording, and joined extents of tensors from outside."""

    made: dict[int, Tensor]
    starts: dict[tuple[int, int], int]

    @classmethod
    def of(cls, operations: Sequence[Operation]) -> "_Memory":
        made: dict[int, Tensor] = {}
        for operation in operations:
            # A view of a tensor that is read makes no memory.
            before = {_storage(tensor) for tensor in operation.read()}
            for tensor in operation.made:
                if tensor.numel() and _storage(tensor) not in before:
                    made.setdefault(_storage(tensor), tensor)
        # Memory from outside may be reached by tensors that overlap; these must count as one place.
        used = [
            tensor for one in operations for tensor in (*one.read(), *one.made) if tensor.numel()
        ]
        starts: dict[tuple[int, int], int] = {}
        start = 0
        end = 0
        # Sorted by address, so one pass merges all extents that overlap.
        for first, last in sorted(
            {extent(tensor) for tensor in used if _storage(tensor) not in made}
        ):
            if first >= end:
                start = first
            end = max(end, last)
            starts[first, last] = start
        return cls(made=made, starts=starts)

    def place(self, tensor: Tensor) -> int:
        storage = _storage(tensor)
        if storage in self.made or not tensor.numel():
            return storage
        return self.starts[extent(tensor)]

    def width(self, place: int) -> int:
        """Return how many numbers a storage of the recording has."""
        root = self.made[place]
        return root.untyped_storage().nbytes() // root.element_size()


@dataclass(eq=False)
class _Use:
    """How operations use memory: by place the distances between rows (0 where all rows use the same numbers)."""

    distances: dict[int, set[int]] = field(default_factory=dict)
    made: set[int] = field(default_factory=set)
    written: set[int] = field(default_factory=set)
    counted: set[int] = field(default_factory=set)

    def add(self, other: "_Use") -> None:
        for place, distances in other.distances.items():
            self.distances.setdefault(place, set()).update(distances)
        self.made |= other.made
        self.written |= other.written
        self.counted |= other.counted

    def allows(self, other: "_Use") -> bool:
        """Whether `other` may follow in the same kernel: no row reads memory that another one writes."""
        for place, distances in other.distances.items():
            # One distance means that each row stays with its own numbers. Two distances in one place mean
            # that a thread would read numbers of another row, and threads of a kernel have no order.
            is_written = place in self.written or place in other.written
            if is_written and len(distances | self.distances.get(place, set())) > 1:
                return False
        # Counters are complete only when all rows have run, so no other operation here may touch them.
        mine = self.distances.keys() - self.counted
        theirs = other.distances.keys() - other.counted
        return self.counted.isdisjoint(theirs) and other.counted.isdisjoint(mine)


@dataclass(eq=False)
class Kernel:
    """Operations that run as one kernel, each with its number of rows: E, or 0 where it has none."""

    operations: list[tuple[Operation, int]] = field(default_factory=list)
    use: _Use = field(default_factory=_Use)
    launch: Callable[[], None] = lambda: None

    def __call__(self) -> None:
        """Run it."""
        self.launch()


class Tape:
    """A recorded function of the rows of a batch as kernels and launches.

    Call it to run them: it reads and writes the memory of the recording, returned tensors included. `num_rows` is E,
    and `returned` are the tensors that are used afterwards.
    """

    def __init__(
        self, recorder: Recorder, *, num_rows: int, returned: Sequence[Shaped[Tensor, "*?shape"]]
    ) -> None:
        self._num_rows = num_rows
        self._device = returned[0].device
        self._memory = _Memory.of(
            [entry for entry in recorder.entries if isinstance(entry, Operation)]
        )
        self.parts: list[Kernel | Operation | Callable[[], None]] = []
        for entry in recorder.entries:
            if not isinstance(entry, Operation):
                self.parts.append(entry)
            elif self._does_something(entry):
                self._add(entry)
            # Its result on the host would be a constant of the kernels.
            elif torch.Tag.nondeterministic_seeded in entry.function.tags:
                raise RuntimeError(
                    f"{entry.function} draws numbers on the host, and would draw them once"
                )
        # Only now, as the memory of a kernel depends on all parts that come after it.
        self._own = self._find_own(returned)
        # Kernels hold addresses only, so these tensors must stay alive.
        self._kept = [
            tensor for place, tensor in self._memory.made.items() if place not in self._own
        ]
        # All sources first, so that they are compiled together.
        modules = [self._compiled(part) for part in self.parts if isinstance(part, Kernel)]
        kernel_loading.load([module for module in modules if module], self._device)
        # Kernels have what they need; a reference here would keep memory that none of them reads.
        self._memory.made.clear()

    def __call__(self) -> None:
        """Run all parts in order."""
        for part in self.parts:
            part()

    def _does_something(self, operation: Operation) -> bool:
        """Whether numbers on the device change: a view changes none, and numbers of the host are constants."""
        made = [
            tensor for tensor in operation.made if self._memory.made.get(_storage(tensor)) is tensor
        ]
        return any(
            tensor.numel() and tensor.device == self._device
            for tensor in (*operation.written, *made)
        )

    def _add(self, operation: Operation) -> None:
        """Put an operation into the kernel that comes last, or into a new one, or leave it to torch."""
        # The count of NaN writes numbers without rows, but runs over the rows of its table.
        first = (*operation.made, *operation.written)[0]
        has_rows = first.ndim > 0 and first.shape[0] == self._num_rows or operation.name in _COUNTS
        rows = self._num_rows if has_rows else 0
        last = self.parts[-1] if self.parts else None
        try:
            # Writing the C++ is the test: it fails for an operation that mixes rows or is unknown.
            use = self._use(operation, rows)
        except NotARowError:
            self.parts.append(operation)
            return
        fits = (
            isinstance(last, Kernel)
            and len(last.operations) < MOST_OPERATIONS
            and last.use.allows(use)
        )
        if isinstance(last, Kernel) and fits:
            kernel = last
        else:
            kernel = Kernel()
        # Numbers that all rows share, written in place: fine in memory that the kernel itself made.
        alone = {place for place in use.written if 0 in use.distances[place]}
        if not alone <= kernel.use.made | use.made:
            self.parts.append(operation)  # each row would write numbers that are there for all
            return
        if kernel is not last:
            self.parts.append(kernel)
        kernel.operations.append((operation, rows))
        kernel.use.add(use)

    def _use(self, operation: Operation, rows: int) -> _Use:
        """Return how an operation uses memory; a NotARowError where it does not keep to its row."""
        # A dry run with made-up addresses, which collects the elements that the loops use.
        cells = Cells(rows=rows, address=lambda _: ("", 0, True), device=self._device)
        row_code.write(operation, cells)
        use = _Use()
        counts = operation.name in _COUNTS
        for tensor, distance, _, _ in (
            element for loop in cells.loops for element in loop.elements
        ):
            root = self._memory.made.get(_storage(tensor))
            # An array of a row's own has one C type, so reinterpreted memory is left to torch.
            if root is not None and root.dtype != tensor.dtype:
                raise NotARowError("memory of two types")
            if not rows and tensor.numel() > MOST_SHARED:
                raise NotARowError("many numbers without rows")
            use.distances.setdefault(self._memory.place(tensor), set()).add(distance)
        use.made = {self._memory.place(tensor) for tensor in operation.made}
        outs = use.made | {self._memory.place(tensor) for tensor in operation.written}
        if counts:
            use.counted = outs
            use.written = set()
        else:
            use.counted = set()
            use.written = outs
        if rows and any(0 in use.distances[place] for place in use.written):
            raise NotARowError("all rows write the same numbers")
        return use

    def _find_own(self, returned: Sequence[Tensor]) -> dict[int, Kernel]:
        """Return the memory that only one kernel uses, by place: it need not exist outside of that kernel."""
        # The parts that use each storage.
        users: dict[int, list[object]] = {}
        for part in self.parts:
            if isinstance(part, Kernel):
                inside = [one for one, _ in part.operations]
            else:
                inside = [part]
            for operation in inside:
                if isinstance(operation, Operation):
                    for tensor in (*operation.read(), *operation.made):
                        users.setdefault(_storage(tensor), []).append(part)
        outside = {_storage(tensor) for tensor in returned}
        own: dict[int, Kernel] = {}
        # A storage that is returned must exist outside of kernels.
        for place in self._memory.made.keys() & users.keys() - outside:
            kernel, *others = users[place]
            is_alone = isinstance(kernel, Kernel) and all(other is kernel for other in others)
            if isinstance(kernel, Kernel) and is_alone and self._own_width(kernel, place):
                own[place] = kernel
        return own

    def _own_width(self, kernel: Kernel, place: int) -> int:
        """Return how many numbers of a storage a row of a kernel uses; 0 where they cannot be an array of the row."""
        width = self._memory.width(place)
        distances = kernel.use.distances.get(place, {0})
        # Without rows each thread keeps a copy of the whole storage.
        if distances == {0}:
            if width <= MOST_SHARED:
                return width
            return 0
        # With rows, only where rows lie one behind the other and fill the storage.
        width, rest = divmod(width, self._num_rows)
        if distances == {width} and not rest:
            return width
        return 0

    def _compiled(self, kernel: Kernel) -> tuple[wp.Module, int] | None:
        """Give a kernel its launch, and return the module to compile; None where nothing reads the kernel's results."""
        # By place its name in C++; places that are kernel arguments; pointers among them by C type;
        # arrays of a row's own; and loops that store shared results at the end.
        names: dict[int, str] = {}
        given: list[int] = []
        pointed: dict[str, str] = {}
        own: list[Own] = []
        ends: list[Loop] = []

        def address(tensor: Tensor) -> tuple[str, int, bool]:
            place = self._memory.place(tensor)
            ctype = CTYPES[tensor.dtype]
            is_own = self._own.get(place) is kernel
            is_shared = place in kernel.use.made and kernel.use.distances[place] == {0}
            if place not in names:
                name = names[place] = f"m{len(names)}"
                if is_own or is_shared:
                    own.append(
                        Own(name, ctype, self._own_width(kernel, place), tensor.element_size())
                    )
                else:
                    pointed[name] = ctype
                if not is_own:
                    given.append(place)
                if is_shared and not is_own:  # each row works it out, and one hands it on
                    end = f"if (row == 0) (({ctype}*)a.{name})[i0] = {name}[i0];"
                    ends.append(
                        Loop((own[-1].size,), end, [Element(tensor, 0, name, f"{name}[i0]")])
                    )
            # A place is a byte address, and C++ counts elements.
            offset = (tensor.data_ptr() - place) // tensor.element_size()
            return names[place], offset, not (is_own or is_shared)

        # Write each operation again, now with true addresses.
        works: list[Work] = []
        changed: set[str] = set()
        for number, (operation, rows) in enumerate(kernel.operations):
            cells = Cells(rows=rows, address=address, device=self._device)
            row_code.write(operation, cells)
            outs = {
                names.get(self._memory.place(one), "")
                for one in (*operation.made, *operation.written)
            }
            changed |= outs
            works += [
                Work(loop, number, set() if operation.name in _COUNTS else outs)
                for loop in cells.loops
            ]
        works += [Work(loop, -1, set()) for loop in ends]
        if not given:
            return None
        # Decide what each lane does, and whether the arrays of the block's rows fit in shared memory.
        kinds = schedule(works, own)
        in_shared = sum(one.size * one.bytes for one in own if kinds[one.name] == SHARED)
        lanes = LANES[self._device.type]
        if not (lanes and BLOCK // lanes * in_shared <= MOST_BYTES):
            lanes = 0
        # Only pointers that no operation writes may be `const`, and be loaded ahead.
        read = {name: ctype for name, ctype in pointed.items() if name not in changed}
        # No two pointers overlap, so reads may move ahead of writes, unless another lane does the writing.
        kept = "" if lanes else "__restrict__"
        pointers = ", ".join(
            f"const {ctype}* __restrict__ {name}" if name in read else f"{ctype}* {kept} {name}"
            for name, ctype in pointed.items()
        )
        calls = ", ".join(f"({ctype}*)a.{name}" for name, ctype in pointed.items())
        # Assemble the text of the kernel and its launch.
        body = source(works, own, kinds, read if lanes else None)
        body = [f"auto run = [&]({pointers}) {{", *body, "};", f"run({calls});"]
        sizes = f"#define LANES {max(lanes, 1)}\n#define BLOCK {BLOCK}"
        used = "using namespace draws;\nusing namespace row_formulas;"
        text = "\n".join([sizes, DEAL, used, *body])
        fields = " ".join(names[place] for place in given)
        launch = QuickLaunch(
            arguments_of((ADDRESS, fields)), text, preamble=_FUNCTIONS, block_dim=BLOCK
        )
        kernel.launch = partial(launch, self._device, (self._num_rows, max(lanes, 1)), *given)
        # Tensors that only this kernel uses need no reference here.
        self._kept += [
            tensor
            for one, _ in kernel.operations
            for tensor in one.read()
            if self._memory.place(tensor) in given
        ]
        # The launch has all that it needs, so the recorded operations and their tensors are dropped.
        kernel.operations.clear()
        return launch.loadable
