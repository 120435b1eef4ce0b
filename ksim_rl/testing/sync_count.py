"""Counts the operations that make the host wait for the device, on any machine."""

import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import PyTree

from ksim_rl.device.recording import OpArgs, OpKwargs, OpOverload

_ALWAYS = {
    "aten::_local_scalar_dense": "a tensor's value read by Python (item, bool, float, int)",
    "aten::nonzero": "nonzero",
    "aten::nonzero_static": "nonzero_static",
    "aten::masked_select": "masked_select",
    "aten::equal": "torch.equal",
    "aten::allclose": "torch.allclose",
    "aten::_linalg_check_errors": "the error check of a torch.linalg function",
    "aten::is_nonzero": "a tensor used as a condition",
    "aten::_unique": "unique",
    "aten::_unique2": "unique",
    "aten::unique_dim": "unique",
    "aten::unique_consecutive": "unique_consecutive",
    "aten::unique_dim_consecutive": "unique_consecutive",
    "aten::bincount": "bincount",
    "aten::histc": "histc",
    "aten::_assert_scalar": "an assertion on a value",
    "aten::lift_fresh": "a tensor made from Python data (torch.tensor, torch.as_tensor)",
    "aten::_pin_memory": "pin_memory",
}
# These never reach the dispatcher on the CPU.
_METHODS = {
    Tensor.tolist: "tolist",
    Tensor.numpy: "numpy",
    Tensor.__array__: "conversion to numpy",
    Tensor.cpu: "cpu",
    Tensor.cuda: "cuda",
}
_INDEXING = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}
_INTERNAL = ("/torch/", "/contextlib.py", __file__)


@dataclass(kw_only=True)
class SyncCount:
    """The syncs that `count_syncs` saw: one line each, with the place in the code."""

    calls: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """Number of syncs."""
        return len(self.calls)

    def report(self) -> str:
        """Return the distinct syncs with their counts, the most frequent first."""
        distinct = sorted(set(self.calls), key=self.calls.count, reverse=True)
        return (
            "\n".join(f"{self.calls.count(call)} x {call}" for call in distinct) or "no host sync"
        )


@contextmanager
def count_syncs() -> Iterator[SyncCount]:
    """Count the host syncs of the code inside, as they would happen on a GPU.

    It sees values read by Python, boolean indexing, results whose size depends on data, copies between devices, and
    tensors made from Python data. It does not see reads of C++ without the dispatcher: on a GPU,
    `torch.cuda.set_sync_debug_mode("error")` is the last word. Inside compiled code it sees nothing.
    """
    count = SyncCount()
    # Two modes: methods of Python, and operators of the dispatcher.
    with _Methods(count), _Operations(count):
        yield count


class _Counting:
    def __init__(self, count: SyncCount) -> None:
        super().__init__()
        self.count = count

    def note(self, what: str | None) -> None:
        if what is not None:
            self.count.calls.append(f"{what} at {_place()}")


class _Methods(_Counting, TorchFunctionMode):
    def __torch_function__(
        self,
        func: Callable[..., PyTree],
        types: Sequence[type],
        args: OpArgs = (),
        kwargs: OpKwargs | None = None,
    ) -> PyTree:
        self.note(_METHODS.get(func))
        return func(*args, **(kwargs or {}))


class _Operations(_Counting, TorchDispatchMode):
    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: Sequence[type],
        args: OpArgs = (),
        kwargs: OpKwargs | None = None,
    ) -> PyTree:
        kwargs = kwargs or {}
        self.note(_why_it_syncs(func, args, kwargs))
        return func(*args, **kwargs)


def _why_it_syncs(func: OpOverload, args: OpArgs, kwargs: OpKwargs) -> str | None:
    # The name without the overload, such as "aten::index".
    name = func._schema.name
    if name in _ALWAYS:
        return _ALWAYS[name]
    # The number of rows that a mask selects is known to the device only.
    if name in _INDEXING and any(
        i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1]
    ):
        return "indexing by a mask"
    if (
        name == "aten::repeat_interleave"
        and kwargs.get("output_size") is None
        and func._overloadname == "Tensor"
    ):
        return "repeat_interleave without output_size"
    if name == "aten::_to_copy" and _differs(args[0].device, kwargs.get("device")):
        return "copy to another device"
    # `a.copy_(b)` has the target first.
    if (
        name == "aten::copy_"
        and isinstance(args[1], Tensor)
        and _differs(args[0].device, args[1].device)
    ):
        # `copy_(source, non_blocking=True)` into pinned memory returns before the copy is done.
        into_pinned = len(args) > 2 and args[2] and args[0].is_cpu and args[0].is_pinned()
        if into_pinned:
            return None
        return "copy between devices"
    return None


def _differs(here: torch.device, there: torch.device | None) -> bool:
    return there is not None and torch.device(there).type != here.type


def _place() -> str:
    """Return file:line of the innermost frames outside torch."""
    places = []
    # Frames of torch and of this module say nothing about the cause.
    for frame in traceback.extract_stack():
        is_internal = any(part in frame.filename for part in _INTERNAL)
        if not is_internal:
            places.append(f"{frame.filename.rsplit('/', 1)[-1]}:{frame.lineno}")
    # Enough to see the term and the line that called it.
    innermost = places[-3:]
    return " < ".join(reversed(innermost))
