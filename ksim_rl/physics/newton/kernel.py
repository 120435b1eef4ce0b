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

CUDA_LANES = 32
vec5 = wp.types.vector(length=5, dtype=float)
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


@wp.struct
class Problem:
    """What the kernel reads of a model and its worlds, what it writes, room for the rows that find none on chip, the
    order in which the worlds are taken up, and the broken `Invariant`s of a debug build.
    """

    iterations: int
    tolerance: wp.array[float]
    ls_tolerance: wp.array[float]
    impratio_invsqrt: wp.array[float]
    M_hinit_i: wp.array[int]
    M_colind: wp.array[int]
    ne: wp.array[int]
    nf: wp.array[int]
    nefc: wp.array[int]
    M: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    contact_friction: wp.array[vec5]
    efc_type: wp.array2d[int]
    efc_id: wp.array2d[int]
    efc_J_rownnz: wp.array2d[int]
    efc_J_rowadr: wp.array2d[int]
    efc_J_colind: wp.array2d[int]
    efc_J: wp.array2d[float]
    efc_D: wp.array2d[float]
    efc_aref: wp.array2d[float]
    efc_frictionloss: wp.array2d[float]
    scratch: wp.array2d[float]
    qacc: wp.array2d[float]
    efc_Ma: wp.array2d[float]
    efc_force: wp.array2d[float]
    efc_state: wp.array2d[int]
    qfrc_constraint: wp.array2d[float]
    solver_niter: wp.array[int]
    overflow: wp.array[int]
    order: wp.array[int]
    broken: wp.array[int]


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
    checked: bool = False,
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
        checked: a debug build, which writes each world's broken `Invariant`s.
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
        "WORLDS_PER_BLOCK": worlds_per_block,
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
