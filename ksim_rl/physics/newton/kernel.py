"""This module makes the one kernel of MuJoCo's Newton solver, in which a warp solves one world until it has converged.

MuJoCo Warp launches about ten kernels per iteration, over all worlds, until the last of them has converged; here no
world waits for another, and what an iteration computes stays on the chip. The algorithm is the same: exact line search
by bracketed Newton steps, and the same tests of convergence, so that the results agree up to rounding. It is written in
C++, since its matrix lies in registers, which needs loops that are unrolled, shuffles and shared memory; the CPU
compiles the same source, for a warp of one lane. Read its parts in their order: layout.cpp, constraints.cpp, cost.cpp,
hessian.cpp, line_search.cpp, newton.cpp.

Source of the algorithm: https://mujoco.readthedocs.io/en/stable/computation/index.html; of its bounds, line
search and tests of convergence: mujoco_warp/_src/solver.py.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false

import enum
import functools
from importlib.resources import files

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.structs import struct_with

CUDA_LANES = 32
SORTING_THREADS = 1024
_PARTS = ("layout", "constraints", "cost", "hessian", "line_search", "newton")
_SOURCE = "".join(files("ksim_rl.physics.newton").joinpath(f"{part}.cpp").read_text() for part in _PARTS)


class Invariant(enum.IntFlag):
    """What holds in every solve of finite numbers; a debug build notes for each world what did not."""

    ROWS_ARE_WHOLE = enum.auto()
    """Rows have a positive D, a bound >= 0 on dry friction, and columns among the degrees of freedom."""
    CONES_ARE_WHOLE = enum.auto()
    """A cone has the row of its normal and 2, 3 or 5 of its tangents, with positive friction."""
    FORCES_ARE_ADMISSIBLE = enum.auto()
    """Contacts and limits push, dry friction keeps to its bound, and forces of contacts lie in their cones."""
    HESSIAN_IS_POSITIVE = enum.auto()
    """Each pivot of its factorization is positive."""
    SEARCH_DESCENDS = enum.auto()
    """The cost falls along the search direction, up to rounding."""
    COST_FALLS = enum.auto()
    """A line search never returns a point that costs more than its start."""


@struct_with(
    ("", mjw.Model, "M_hinit_i M_colind"),
    ("", mjw.Option, "tolerance ls_tolerance impratio_invsqrt iterations"),
    ("", mjw.Data, "ne nf nefc M qacc qacc_warmstart qfrc_smooth qfrc_constraint solver_niter overflow"),
    ("contact_", mjw.Contact, "friction dim"),
    ("efc_", mjw.Constraint, "type id J_rownnz J_rowadr D aref frictionloss Ma force state"),
)
class Problem:
    """What the kernel reads of a model and its worlds, what it writes, room for the rows that find none on chip, the
    order in which the worlds are taken up, and the broken `Invariant`s of a debug build.
    """

    efc_J_colind: wp.array2d[int]
    efc_J: wp.array2d[float]
    scratch: wp.array2d[float]
    order: wp.array[int]
    broken: wp.array[int]


def row_stride(nv: int) -> int:
    """Return the floats from a row of J or M to the next."""
    # Whole groups of four, which are loaded at once; an odd number of them, so that the lanes' rows lie in other banks.
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


@functools.cache
def newton_kernel(
    nv: int, njmax: int, elliptic: bool, ls_iterations: int, lanes: int, rows_on_chip: int, checked: bool
) -> wp.Kernel:
    """Return the kernel of a `Problem` with `nv` degrees of freedom; launch it over (worlds, lanes).

    There are 32 lanes on CUDA and 1 on the CPU. Rows beyond those on the chip (in shared memory) are in the scratch. A
    `checked` (debug) build writes each world's broken `Invariant`s.
    """
    states, rows = mujoco.mjtConstraintState, mujoco.mjtConstraint
    constants = {
        "NV": nv,
        "NJ": njmax,
        "PADDED_ROWS": _padded(njmax),
        "STRIDE": row_stride(nv),
        "COLUMN": _column(nv),
        "ROWS_ON_CHIP": rows_on_chip,
        "LANES": lanes,
        "FLOATS": floats_per_world(nv, njmax, elliptic=elliptic, rows_on_chip=rows_on_chip),
        "MOST_TRIALS": ls_iterations,
        "ELLIPTIC": elliptic,
        "ELLIPTIC_CONTACT": rows.mjCNSTR_CONTACT_ELLIPTIC,
        "SATISFIED": states.mjCNSTRSTATE_SATISFIED,
        "QUADRATIC": states.mjCNSTRSTATE_QUADRATIC,
        "LINEAR_NEGATIVE": states.mjCNSTRSTATE_LINEARNEG,
        "LINEAR_POSITIVE": states.mjCNSTRSTATE_LINEARPOS,
        "CURVED": states.mjCNSTRSTATE_CONE,
        "OUT_OF_ITERATIONS": mjw.OverflowType.ITERATIONS,
        "OUT_OF_LS_ITERATIONS": mjw.OverflowType.LS_ITERATIONS,
        "CHECKED": checked,
        **{str(invariant.name): invariant for invariant in Invariant},
    }
    snippet = (
        "".join(f"constexpr int {name} = {int(value)};\n" for name, value in constants.items()) + _SOURCE
    )

    @wp.func_native(snippet)
    def solve_world(world: int, lane: int, problem: Problem) -> None: ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options={"block_dim": lanes, "fast_math": True},
    )
    def kernel(problem: Problem):
        world, lane = wp.tid()
        solve_world(problem.order[world], lane, problem)

    return kernel


@wp.func_native("""
#if defined(__CUDA_ARCH__)
constexpr int KEYS = 64;
__shared__ int places[KEYS];  // how many worlds have a key, then where the next of them goes
const int thread = threadIdx.x, threads = blockDim.x, worlds = problem.order.shape[0];
auto key_of = [&](int world) {
    const int time = 2 * problem.solver_niter.data[world] + problem.nefc.data[world] / 4;
    return KEYS - 1 - wp::min(time, KEYS - 1);
};
for (int key = thread; key < KEYS; key += threads)
    places[key] = 0;
__syncthreads();
for (int world = thread; world < worlds; world += threads)
    atomicAdd(places + key_of(world), 1);
__syncthreads();
if (thread == 0) {
    int before = 0;
    for (int key = 0; key < KEYS; ++key) {
        const int count = places[key];
        places[key] = before;
        before += count;
    }
}
__syncthreads();
for (int world = thread; world < worlds; world += threads)
    problem.order.data[atomicAdd(places + key_of(world), 1)] = world;
#endif
""")
def sort_by_counting(problem: Problem) -> None:
    """Write the worlds in the order of their keys."""


@wp.kernel(
    module="unique", enable_backward=False, grid_stride=False, module_options={"block_dim": SORTING_THREADS}
)
def sort_worlds(problem: Problem):
    """Write the order of the worlds, by one block."""
    sort_by_counting(problem)


def put_longest_first(problem: Problem) -> None:
    """Let a GPU take up those worlds first which will take longest, by their last iterations and their rows.

    A world that takes three times as long as most would otherwise start late and leave the GPU waiting for it alone.
    """
    wp.launch(sort_worlds, dim=SORTING_THREADS, inputs=[problem], block_dim=SORTING_THREADS)
