"""Records torch operations and Warp launches one by one, so that they can be compiled."""

import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from jaxtyping import Shaped
from torch import Tensor
from torch._ops import OpOverload as OpOverload
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import PyTree, tree_leaves

_HOST_READS = frozenset({"_local_scalar_dense", "equal", "item", "masked_select", "nonzero"})
# On the CPU these never reach the dispatcher.
_HOST_METHODS = frozenset({Tensor.numpy, Tensor.tolist, Tensor.__array__, Tensor.__dlpack__})
# The arguments of torch's operators; their results are trees, too.
OpArgs: TypeAlias = tuple[PyTree, ...]
OpKwargs: TypeAlias = dict[str, PyTree]
_INTERNAL = ("/torch/", "/tensordict/", "/contextlib.py", __file__)


class _Recording(threading.local):
    recorder: "Recorder | None" = None


_recording = _Recording()


def is_recording() -> bool:
    """Whether this thread writes down torch's operations: then every kernel has to be an operator of torch."""
    return _recording.recorder is not None


def paused() -> AbstractContextManager[None]:
    """Write nothing down in this block, if this thread writes down anything at all."""
    recorder = _recording.recorder
    if recorder is None:
        return nullcontext()
    return recorder.paused()


def launched(launch: Callable[[], None]) -> bool:
    """Make a launch of Warp part of the recording, and say so; without a recording, do nothing."""
    recorder = _recording.recorder
    if recorder is None:
        return False
    with recorder.paused():
        # It runs now, too: later operations of the recording need its results.
        launch()
    recorder.entries.append(launch)
    return True


@dataclass(frozen=True, eq=False)
class Operation:
    """One call of an operator, the tensors that it made, and those that it wrote."""

    function: OpOverload
    args: OpArgs
    kwargs: OpKwargs
    made: list[Tensor]
    written: list[Tensor]

    @property
    def name(self) -> str:
        """The name of the operator, whatever its arguments are."""
        return self.function.overloadpacket.__name__

    def read(self) -> list[Shaped[Tensor, "*?shape"]]:
        """Return the tensors among the arguments."""
        return _tensors((self.args, self.kwargs))

    def __call__(self) -> None:
        """Do it once more, in the same memory."""
        result = self.function(*self.args, **self.kwargs)
        if self.made:
            # Results that are written arguments hold the new numbers already.
            written = {id(old) for old in self.written}
            again = [new for new in _tensors(result) if id(new) not in written]
            for old, new in zip(self.made, again, strict=True):
                old.copy_(new)


def _tensors(tree: PyTree) -> list[Tensor]:
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
        # Without this thread's recorder, and outside of its dispatch mode: the block runs as if nothing was recorded.
        try:
            with _disable_current_modes():
                yield
        finally:
            _recording.recorder = self

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: Sequence[type],
        args: OpArgs = (),
        kwargs: OpKwargs | None = None,
    ) -> PyTree:
        kwargs = kwargs or {}
        # A number that Python reads would be a constant in the recording.
        if func.overloadpacket.__name__ in _HOST_READS:
            raise RuntimeError(f"{func} reads the device on the host, at {_place()}")
        # Operators that this one calls are part of it, and are no entries of their own.
        _recording.recorder = None
        try:
            result = func(*args, **kwargs)
        finally:
            _recording.recorder = self
        # An operator in place returns an argument, which it did not make.
        read = {id(tensor) for tensor in _tensors((args, kwargs))}
        made = [tensor for tensor in _tensors(result) if id(tensor) not in read]
        written = written_by(func, args, kwargs)
        # Views make tensors, too; only operators without any effect are left out.
        if made or written:
            self.entries.append(Operation(func, args, kwargs, made, written))
        return result


class _HostMethods(TorchFunctionMode):
    """Refuses tensor methods that read numbers into Python, where they would become constants of the recording."""

    def __torch_function__(
        self,
        func: Callable[..., PyTree],
        types: Sequence[type],
        args: OpArgs = (),
        kwargs: OpKwargs | None = None,
    ) -> PyTree:
        # Methods that bypass the dispatcher are seen here alone.
        if func in _HOST_METHODS and is_recording():
            raise RuntimeError(f"{func.__name__} reads the device on the host, at {_place()}")
        return func(*args, **(kwargs or {}))


def _place() -> str:
    """Return file and line of the code that runs, outside of torch."""
    # The frames of torch itself tell a user nothing.
    frame = sys._getframe(1)
    while frame.f_back is not None and any(part in frame.f_code.co_filename for part in _INTERNAL):
        frame = frame.f_back
    return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"


def written_by(func: OpOverload, args: OpArgs, kwargs: OpKwargs) -> list[Shaped[Tensor, "*?shape"]]:
    """Return the tensors among the arguments of an operator that it writes."""
    written: list[Tensor] = []
    # The schema of an operator says which arguments it writes.
    for place, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            if place < len(args):
                given = args[place]
            else:
                given = kwargs.get(argument.name)
            written += _tensors(given)
    return written


@contextmanager
def recorded() -> Iterator[Recorder]:
    """Write down torch's operations and Warp's launches in this block."""
    assert _recording.recorder is None, "recordings do not nest"
    recorder = _recording.recorder = Recorder()
    try:
        with _HostMethods(), recorder:
            yield recorder
    finally:
        _recording.recorder = None
