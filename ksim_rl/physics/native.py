"""Compiles kernels of our own C++, with the arrays of a model and its worlds that the C++ names."""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco_warp as mjw
import warp as wp

from ksim_rl.device import headers
from ksim_rl.device.upstream import with_preamble
from ksim_rl.physics.structs import Field, filled, values_of
from ksim_rl.physics.upstream import Struct

FEW_WORLDS = 8192  # more fill a GPU with fewer lanes each
_ARRAYS = {1: wp.array, 2: wp.array2d, 3: wp.array3d}


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
    """Return a launcher of the kernel of a header over (worlds, lanes) in blocks of `threads`; see `headers`.

    Arrays have to be in their final place. A field of its `Arguments` is the one of that name of `own`, or else of the
    model, its options or its worlds; see `values_of`. A launch may change scalars of `own`, by name. The constants get
    their names in capitals, and LANES and THREADS beside them.
    """
    text = headers.text_of(header, _constants(constants, lanes, threads))
    owners = own, warp_model, warp_model.opt, warp_data_E
    fields = values_of(tuple(headers.arguments_of(text)), *owners)
    types = tuple((name, _type_of(value)) for name, value in fields.items())
    kernel, struct = _kernel(header, text, types, lanes, threads, build)
    problem = filled(struct, *owners)
    dim = (warp_data_E.nworld, lanes)
    device = warp_data_E.qpos.device

    # The struct is filled once: only scalars change from launch to launch.
    def launch(**changes: Field) -> None:
        for name, value in changes.items():
            setattr(problem, name, value)
        wp.launch(kernel, dim=dim, inputs=[problem], block_dim=threads, device=device)

    return launch


def _constants(
    constants: Mapping[str, headers.Constant], lanes: int, threads: int
) -> dict[str, headers.Constant]:
    values: dict[str, headers.Constant] = {"LANES": lanes, "THREADS": threads}
    for name, value in constants.items():
        # Enums and truths are whole numbers in C++.
        values[name.upper()] = value if isinstance(value, Sequence) else int(value)
    return values


def _type_of(value: Any) -> type:
    if isinstance(value, wp.array):
        return _ARRAYS[value.ndim][value.dtype]
    return type(value)


@functools.cache
def _kernel(
    header: str,
    text: str,
    types: tuple[tuple[str, type], ...],
    lanes: int,
    threads: int,
    build: Build,
) -> tuple[wp.Kernel, Struct]:
    """Return the kernel of a header with this text, and the struct that it takes."""

    # A struct of the arrays that the kernel reads.
    class Problem: ...

    Problem.__annotations__ = dict(types)
    struct = wp.struct(Problem)
    # Or else loops over nothing are compiled.
    known = f"__builtin_assume(lane >= 0 && lane < {lanes});\n"
    values = [f"problem.{name}" for name, _ in types]
    call = headers.call_of(header, ("world", "lane"), values)

    @wp.func_native(known + call)
    def body(world: int, lane: int, problem: struct) -> None: ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        cuda_max_registers=build.max_registers,
        module_options={
            "block_dim": threads,
            "fast_math": build.fast_math,
            "extra_build_options": with_preamble(text),
        },
    )
    def kernel(problem: struct):
        world, lane = wp.tid()
        body(world, lane, problem)

    return kernel, struct
