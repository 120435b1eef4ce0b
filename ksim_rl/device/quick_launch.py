"""Launches kernels in C++ at little cost from Python, on Warp, which is imported at the first launch.

`wp.launch` packs every argument each time, which takes longer than most small kernels run. Warp can record a launch and
issue it again; then only the bytes of its arguments are written, in one go.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from inspect import signature
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar
from weakref import WeakSet

import torch
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.device import headers, recording

if TYPE_CHECKING:
    import warp as wp

    from ksim_rl.device.native_kernel import NativeKernel

R = TypeVar("R")
ADDRESS = "uint64"
"""The type of a tensor's address among arguments, as wrapping a tensor takes longer than the launch."""


def arguments_of(*fields: tuple[type | str, str]) -> dict[str, type | str]:
    """Return the arguments of a `QuickLaunch` in order: types, each with names and blanks between.

    A type is `int`, `float` or the name of one of Warp's.
    """
    # The order of the struct's fields is the order of these names.
    return {name: kind for kind, names in fields for name in names.split()}


_KINDS: dict[str, type | str] = {
    "int": int,
    "float": float,
    "long long": "int64",
    "unsigned": "uint32",
}


def launch_of(
    header: str, constants: Mapping[str, headers.Constant] | None = None
) -> "QuickLaunch":
    """Return the launch of the kernel of a header; see `headers`.

    Its `run` gets the two indices of a thread and the struct `Arguments`, whose fields are the values of a launch in
    order: numbers, and addresses of tensors where it has pointers. The constants are those that the header is given.
    """
    text = headers.text_of(header, constants)
    fields = headers.arguments_of(text)
    kinds: dict[str, type | str] = {}
    values: list[str] = []
    for field, ctype in fields.items():
        is_pointer = ctype.endswith("*")
        assert is_pointer or ctype in _KINDS, (
            f"{header}: {field} is of type {ctype!r}: expected a pointer, or one of {[*_KINDS]}"
        )
        kinds[field] = ADDRESS if is_pointer else _KINDS[ctype]
        values.append(f"({ctype})a.{field}")
    call = headers.call_of(header, ("row", "lane"), values)
    return QuickLaunch(kinds, call, preamble=text)


class QuickLaunch:
    """One kernel in C++ whose only argument, `a`, is a struct of numbers and addresses, launched on torch's stream.

    The source runs for each pair of `indices` within the launch's dim, and may use what the text of the `preamble`
    defines. The kernel has no gradients. It is made at the first launch, so that a module with a kernel can be imported
    where there is no Warp.
    """

    existing: ClassVar[WeakSet["QuickLaunch"]] = WeakSet()

    def __init__(
        self,
        arguments: Mapping[str, type | str],
        source: str,
        indices: tuple[str, str] = ("row", "lane"),
        *,
        preamble: str = "",
        block_dim: int = 256,
    ) -> None:
        self._arguments = arguments
        self._source = source
        self._indices = indices
        self._preamble = preamble
        self._block_dim = block_dim
        self._kernel: NativeKernel | None = None
        self._making = threading.Lock()
        # A thread may go through the old one.
        QuickLaunch.existing = WeakSet([*QuickLaunch.existing, self])

    def __call__(self, device: torch.device, dim: tuple[int, int], *values: float) -> None:
        """Launch with one value per field of the struct, in their order; do nothing for a dim of 0."""
        if 0 in dim:
            return
        # As an operator, the recording would have noted it; as a launch, it would be lost.
        assert not recording.is_recording(), (
            "a kernel that is no operator of torch cannot be recorded"
        )
        kernel = self._kernel or self._made()
        kernel.launch(device, dim, values)

    @property
    def loadable(self) -> "tuple[wp.Module, int]":
        """The module that Warp compiles, and the size of blocks."""
        kernel = self._kernel or self._made()
        return kernel.loadable

    def _made(self) -> "NativeKernel":
        # Warp takes a second to import, and may be absent where nobody launches anything.
        from ksim_rl.device.native_kernel import NativeKernel

        # Two threads may make the first launch at the same time.
        with self._making:
            if self._kernel is None:
                self._kernel = NativeKernel(
                    self._arguments,
                    self._source,
                    self._indices,
                    preamble=self._preamble,
                    block_dim=self._block_dim,
                )
        return self._kernel


@cache
def has_warp() -> bool:
    """Whether Warp is installed; where it is not, torch does the work of operators."""
    try:
        import warp  # noqa: F401
    # A package that Warp itself lacks is another fault, which is not to be hidden.
    except ModuleNotFoundError as error:
        if error.name != "warp":
            raise
        return False
    return True


def as_operator(
    name: str,
    launch: Callable[..., R],
    fake: Callable[..., R],
    *,
    mutates: Sequence[str] = (),
    in_torch: Callable[..., R] | None = None,
) -> Callable[..., R]:
    """Return `launch` as a function that is a torch operator where code is traced.

    Eager code goes past torch's dispatcher, which takes longer than the launch. `fake` returns an empty result for the
    arguments, of which those named in `mutates` are changed. `in_torch` does the same without a kernel, where Warp is
    not installed.
    """
    # torch 2.11 looks for each of these among the arguments that were given, without those that equal their defaults.
    defaults = {
        name for name, own in signature(launch).parameters.items() if own.default is not own.empty
    }
    assert not defaults & set(mutates), f"{name}: arguments that are changed have no default"
    if in_torch is None:
        chosen = launch
    else:
        chosen = _by_kernel_or_torch(launch, in_torch)
    # The operator exists for tracing and recording only.
    operator = torch.library.custom_op(f"ksim_rl::{name}", chosen, mutates_args=mutates)
    operator.register_fake(fake)

    def run(*arguments: object) -> R:
        is_traced = torch.compiler.is_compiling() or recording.is_recording()
        return (operator if is_traced else chosen)(*arguments)

    return run


def _by_kernel_or_torch(launch: Callable[..., R], in_torch: Callable[..., R]) -> Callable[..., R]:
    # It keeps the signature of `launch`, which torch reads.
    @wraps(launch)
    def run(*arguments: Any) -> R:
        work = launch if has_warp() else in_torch
        return work(*arguments)

    return run


def address(tensor: Shaped[Tensor, "*shape"] | None) -> int:
    """Return where a tensor lies; 0 for None."""
    if tensor is None:
        return 0
    return tensor.data_ptr()
