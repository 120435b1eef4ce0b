"""Compiles kernels of our own C++, with the arrays of a model and its worlds that the C++ names."""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco_warp as mjw
import warp as wp

from ksim_rl.device import headers, quick_launch
from ksim_rl.device.upstream import with_preamble
from ksim_rl.physics.structs import Field, filled, values_of
from ksim_rl.physics.upstream import Struct

FEW_WORLDS = 8192  # more fill a GPU with fewer lanes each
_ARRAYS = {1: wp.array, 2: wp.array2d, 3: wp.array3d}


def source_of(folder: str, parts: tuple[str, ...]) -> str:
    """Return the C++ of a kernel, whose parts lie in a folder of this room."""
    return quick_launch.source_of(f"ksim_rl.physics.{folder}", *parts)


def names_of(*enums: Any) -> dict[str, int]:
    """Return the members of enums of MuJoCo's, without the prefixes of their names."""
    return {
        name.partition("_")[2]: int(kind)
        for enum in enums
        for name, kind in enum.__members__.items()
    }


@dataclass(frozen=True, kw_only=True)
class Build:
    """How a kernel is compiled: with fast arithmetic, and with at most so many registers for each thread."""

    fast_math: bool = False
    max_registers: int | None = None


@dataclass(frozen=True, kw_only=True)
class Source:
    """The C++ of a kernel: the body of its function, and what stands before that function."""

    body: str
    preamble: str = ""


def launcher(
    source: str,
    constants: Mapping[str, int],
    own: Mapping[str, Field],
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    lanes: int,
    threads: int,
    build: Build = Build(),
) -> Callable[..., None]:
    """Return a launcher of C++ over (worlds, lanes) in blocks of `threads`, with arrays in their final place.

    The C++ is the body of a function of `world`, `lane` and `problem`; before it stand the constants, by their names in
    capitals, with LANES and THREADS. Its `problem.x` is x of `own`, or else of the model, its options or its
    worlds; see `values_of`. A launch may change scalars of `own`, by name.
    """
    # The C++ itself says which arrays it reads, so that no list of them can go out of date.
    names = dict.fromkeys(re.findall(r"\bproblem\.(\w+)", source))
    # Constants are whole numbers, so that kernels of equal sizes are one in the cache.
    values = _constants(constants, lanes, threads)
    named = "".join(f"constexpr int {name} = {value};\n" for name, value in values.items())
    owners = own, warp_model, warp_model.opt, warp_data_E
    return _launch_of(
        Source(body=named + source), tuple(names), owners, lanes=lanes, threads=threads, build=build
    )


def launcher_of(
    header: str,
    constants: Mapping[str, headers.Constant],
    own: Mapping[str, Field],
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    lanes: int,
    threads: int,
    build: Build = Build(),
) -> Callable[..., None]:
    """Return a launcher of the kernel of a header over (worlds, lanes); see `launcher`, and `headers`.

    A field of its `Arguments` is the one of that name of `own`, or else of the model, its options or its worlds.
    """
    text = headers.text_of(header, _constants(constants, lanes, threads))
    fields = headers.arguments_of(text)
    values = [f"problem.{name}" for name in fields]
    body = headers.call_of(header, ("world", "lane"), values)
    owners = own, warp_model, warp_model.opt, warp_data_E
    return _launch_of(
        Source(body=body, preamble=text),
        tuple(fields),
        owners,
        lanes=lanes,
        threads=threads,
        build=build,
    )


def _constants(
    constants: Mapping[str, headers.Constant], lanes: int, threads: int
) -> dict[str, headers.Constant]:
    values: dict[str, headers.Constant] = {"LANES": lanes, "THREADS": threads}
    for name, value in constants.items():
        # Enums and truths are whole numbers in C++.
        values[name.upper()] = value if isinstance(value, Sequence) else int(value)
    return values


def _launch_of(
    source: Source,
    names: tuple[str, ...],
    owners: tuple[Mapping[str, Field], mjw.Model, mjw.Option, mjw.Data],
    *,
    lanes: int,
    threads: int,
    build: Build,
) -> Callable[..., None]:
    fields = values_of(names, *owners)
    types = tuple((name, _type_of(value)) for name, value in fields.items())
    kernel, struct = _kernel(source, types, lanes, threads, build)
    problem = filled(struct, *owners)
    *_, warp_data_E = owners
    dim = (warp_data_E.nworld, lanes)
    device = warp_data_E.qpos.device

    # The struct is filled once: only scalars change from launch to launch.
    def launch(**changes: Field) -> None:
        for name, value in changes.items():
            setattr(problem, name, value)
        wp.launch(kernel, dim=dim, inputs=[problem], block_dim=threads, device=device)

    return launch


def _type_of(value: Any) -> type:
    if isinstance(value, wp.array):
        return _ARRAYS[value.ndim][value.dtype]
    return type(value)


@functools.cache
def _kernel(
    source: Source,
    types: tuple[tuple[str, type], ...],
    lanes: int,
    threads: int,
    build: Build,
) -> tuple[wp.Kernel, Struct]:
    """Return the kernel, and the struct that it takes."""

    # A struct of the arrays that this source reads.
    class Problem: ...

    Problem.__annotations__ = dict(types)
    struct = wp.struct(Problem)
    # Or else loops over nothing are compiled.
    known = f"__builtin_assume(lane >= 0 && lane < {lanes});\n"

    @wp.func_native(known + source.body)
    def body(world: int, lane: int, problem: struct) -> None: ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        cuda_max_registers=build.max_registers,
        module_options={
            "block_dim": threads,
            "fast_math": build.fast_math,
            "extra_build_options": with_preamble(source.preamble),
        },
    )
    def kernel(problem: struct):
        world, lane = wp.tid()
        body(world, lane, problem)

    return kernel, struct
