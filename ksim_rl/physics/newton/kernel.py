"""MuJoCo's Newton solver as one kernel: a warp solves a world from its start until that world has converged.

MuJoCo Warp launches about ten kernels per iteration, over all worlds, until the last of them has converged; here no
world waits for another, and what an iteration computes stays on the chip. The algorithm is the same: exact line search
by bracketed Newton steps, and the same tests of convergence, so that the results agree up to rounding. It is written in
C++ (*.cpp), since its matrix lies in registers, which needs loops that are unrolled, shuffles and shared
memory; the CPU compiles the same source, for a warp of one lane.

Source of the algorithm: https://mujoco.readthedocs.io/en/stable/computation/index.html; of its bounds, line
search and tests of convergence: mujoco_warp/_src/solver.py.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false

import functools
from importlib.resources import files

import mujoco_warp as mjw
import warp as wp

CUDA_LANES = 32
vec5 = wp.types.vector(length=5, dtype=float)
_PARTS = ("memory.cpp", "rows.cpp", "hessian.cpp", "solver.cpp")
_SOURCE = "".join(files("ksim_rl.physics.newton").joinpath(part).read_text() for part in _PARTS)


@wp.struct
class Problem:
    """What the kernel reads of a model and its worlds, what it writes, room for the rows that find none on chip, and
    the order in which the worlds are taken up.
    """

    iterations: int
    tolerance: wp.array[float]
    ls_tolerance: wp.array[float]
    impratio_invsqrt: wp.array[float]
    M_row: wp.array[int]
    M_col: wp.array[int]
    ne: wp.array[int]
    nf: wp.array[int]
    nefc: wp.array[int]
    M: wp.array2d[float]
    warmstart: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    contact_friction: wp.array[vec5]
    efc_type: wp.array2d[int]
    efc_id: wp.array2d[int]
    J_rownnz: wp.array2d[int]
    J_rowadr: wp.array2d[int]
    J_colind: wp.array2d[int]
    J_values: wp.array2d[float]
    efc_D: wp.array2d[float]
    efc_aref: wp.array2d[float]
    efc_limit: wp.array2d[float]
    scratch: wp.array2d[float]
    qacc: wp.array2d[float]
    efc_Ma: wp.array2d[float]
    efc_force: wp.array2d[float]
    efc_state: wp.array2d[int]
    qfrc_constraint: wp.array2d[float]
    solver_niter: wp.array[int]
    overflow: wp.array[int]
    order: wp.array[int]


def row_stride(nv: int) -> int:
    """Return the floats from a row of J or M to the next.

    Whole groups of four, which are loaded at once, and an odd number of groups, so that the lanes' rows lie in
    different banks.
    """
    return 4 * (-(-nv // 4) | 1)


def floats_per_world(nv: int, njmax: int, *, elliptic: bool, rows_on_chip: int) -> int:
    """Return how many floats the lanes of a world share."""
    stride, padded_rows = row_stride(nv), _padded(njmax)
    cones = 4 * (padded_rows + 4) if elliptic else 0
    return (nv + rows_on_chip) * stride + 2 * _column(nv) + stride + 7 * padded_rows + cones


def _padded(njmax: int) -> int:
    return 4 * -(-njmax // 4)


def _column(nv: int) -> int:
    # A column of a whole block has the entries of the block twice; one more is that of the gradient.
    return _padded(nv + 1 + (CUDA_LANES if nv >= CUDA_LANES else 0))


def constants(
    *,
    nv: int,
    njmax: int,
    elliptic: bool,
    ls_iterations: int,
    lanes: int,
    rows_on_chip: int,
    worlds_per_block: int,
) -> dict[str, int]:
    """Return what the C++ source has to know when it is compiled, by its names there."""
    return {
        "NV": nv,
        "NJ": njmax,
        "PADDED_ROWS": _padded(njmax),
        "STRIDE": row_stride(nv),
        "COLUMN": _column(nv),
        "ROWS_ON_CHIP": rows_on_chip,
        "LANES": lanes,
        "WORLDS_PER_BLOCK": worlds_per_block,
        "FLOATS": floats_per_world(nv, njmax, elliptic=elliptic, rows_on_chip=rows_on_chip),
        "MOST_TRIALS": ls_iterations,
        "ELLIPTIC": int(elliptic),
        "OUT_OF_ITERATIONS": int(mjw.OverflowType.ITERATIONS),
        "OUT_OF_LS_ITERATIONS": int(mjw.OverflowType.LS_ITERATIONS),
    }


@functools.cache
def newton_kernel(
    *,
    nv: int,
    njmax: int,
    elliptic: bool,
    ls_iterations: int,
    lanes: int,
    rows_on_chip: int,
    worlds_per_block: int,
    min_blocks: int,
) -> wp.Kernel:
    """Return the kernel of a `Problem` with `nv` degrees of freedom; launch it over (worlds, lanes).

    Args:
        nv: number of degrees of freedom.
        njmax: most rows of a world.
        elliptic: whether friction cones are elliptic.
        ls_iterations: most trials of a line search.
        lanes: 32 on CUDA, 1 on the CPU.
        rows_on_chip: rows that the shared memory of a world holds; those beyond are in the scratch.
        worlds_per_block: worlds that share a block.
        min_blocks: blocks that a multiprocessor is to hold at once, which bounds the registers; 0 does not.
    """
    known = constants(
        nv=nv,
        njmax=njmax,
        elliptic=elliptic,
        ls_iterations=ls_iterations,
        lanes=lanes,
        rows_on_chip=rows_on_chip,
        worlds_per_block=worlds_per_block,
    )
    snippet = "".join(f"constexpr int {name} = {value};\n" for name, value in known.items()) + _SOURCE

    @wp.func_native(snippet)
    def solve_world(world: int, lane: int, problem: Problem) -> None: ...

    block = worlds_per_block * lanes
    bounds = {"launch_bounds": (block, min_blocks)} if min_blocks else {}

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options={"block_dim": block, "fast_math": True},
        **bounds,
    )
    def kernel(problem: Problem):
        world, lane = wp.tid()
        solve_world(problem.order[world], lane, problem)

    return kernel
