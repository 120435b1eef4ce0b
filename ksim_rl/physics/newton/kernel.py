"""Makes the one kernel of MuJoCo's Newton solver, in which a warp solves one world until it has converged.

MuJoCo Warp launches about ten kernels per iteration, over all worlds, until the last of them has converged; here no
world waits for another, and the results of an iteration stay in shared memory. The algorithm is the same, with the same
tests of convergence, but for a line search that is no more exact than iterations need; costs agree within the
tolerance. It is written in C++, since its matrix lies in registers, which needs loops that are unrolled, shuffles and
shared memory; the CPU compiles the same source, for a warp of one lane. Read newton.cuh.

Source of the algorithm: https://mujoco.readthedocs.io/en/stable/computation/index.html; of its bounds and
tests of convergence: mujoco_warp/_src/solver.py.
"""

# pyright: reportInvalidTypeForm=false

import enum
from collections.abc import Callable, Mapping

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.device import headers
from ksim_rl.device.upstream import with_preamble
from ksim_rl.physics import native
from ksim_rl.physics.newton.limbs import Limbs, padded, row_stride

CUDA_LANES = 32
SORTING_THREADS = 1024
_SOLVER = "ksim_rl/physics/newton/newton.cuh"


class Invariant(enum.IntFlag):
    """Invariants of every solve of finite numbers; a debug build notes for each world which ones broke."""

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


def layout(
    nv: int, njmax: int, limbs: Limbs, *, ntendon: int, elliptic: bool, rows_in_shared: int
) -> dict[str, int]:
    """Return the sizes of the arrays that a world's lanes share, by names of the C++, and their sum in `FLOATS`."""
    # Arms couple a limb to each degree of freedom of the trunk; one more has the gradient.
    arms = len(limbs.trunk) + 1
    chains = len(limbs.chains)
    trunk = padded(len(limbs.trunk))
    limb = len(limbs.chains[-1]) if chains else 1
    stride = row_stride(nv)
    # Rows of one limb have columns of the trunk and of that limb only.
    if chains:
        narrow = row_stride(trunk + limb)
    else:
        narrow = stride
    # A column of a whole block has the entries of the block twice; one more is the gradient's.
    column = padded(nv + 1 + (CUDA_LANES if nv >= CUDA_LANES else 0))
    # Part 4 of the C++ has blocks and arms of limbs, then the trunk; part 6 has two columns, or in the end two rows.
    of_limbs = chains * (limb + arms) * padded(limb) + max(
        padded(arms * (arms + 1) // 2), 2 * narrow
    )
    workspace = max(2 * column, 2 * stride, of_limbs)
    spread = trunk + chains * padded(limb)
    # How many lanes sum the tile of a limb, a power of two; each keeps three rows of it in registers.
    if chains:
        lanes = 1 << (CUDA_LANES // chains).bit_length() - 1
    else:
        lanes = 0
    # Padded, so that lanes load four floats in one go.
    rows = padded(njmax)
    if len(limbs.trunk) + limb <= min(lanes + 1, 12):
        tile = lanes
    else:
        tile = 0
    # Of cones, or else of dry friction.
    bounds = rows if elliptic else padded(min(nv + ntendon, njmax))
    # The inertia matrix and one vector, rows of the Jacobian, workspace, a vector by limbs, bounds, numbers per row.
    floats = (
        (nv + 1) * stride
        + rows_in_shared * narrow
        + workspace
        + spread
        + bounds
        + 4 * rows
        + rows // 2
    )
    return {
        "NV": nv,
        "NJ": njmax,
        "STRIDE": stride,
        "NARROW": narrow,
        "TRUNK": len(limbs.trunk),
        "LIMBS": chains,
        "LIMB": limb,
        "SPREAD": spread,
        "WORKSPACE": workspace,
        "COLUMN": column,
        "BOUNDS": bounds,
        "ROWS_IN_SHARED": rows_in_shared,
        "TILE": tile,
        "ELLIPTIC": elliptic,
        "FLOATS": floats + (4 * rows + rows // 2 if elliptic else 0) + (rows // 2 if tile else 0),
    }


def launcher(
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    own: Mapping[str, wp.array],
    sizes: Mapping[str, int],
    *,
    lanes: int,
    max_registers: int | None,
    checked: bool,
) -> Callable[[], None]:
    """Return a launcher of the kernel.

    The `sizes` come from `layout`. There are 32 lanes on CUDA and 1 on the CPU. Rows that find no room in
    shared memory are in the scratch. A `checked` (debug) build writes each world's broken `Invariant`s. Of `own` it
    takes `efc_J_colind` and `efc_J`, the `scratch`, the tables of `limbs`, the `order` in which the worlds are taken
    up, and `broken`.
    """
    states = mujoco.mjtConstraintState
    rows = mujoco.mjtConstraint
    # Names of the C++ that are MuJoCo's enums, and the limits of the solver.
    constants = {
        **sizes,
        "MOST_TRIALS": warp_model.opt.ls_iterations,
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
    given = _SOLVER, constants, own, warp_model, warp_data_E
    build = native.Build(fast_math=True, max_registers=max_registers)
    return native.launcher_of(*given, lanes=lanes, threads=lanes, build=build)


_SORT = "ksim_rl/physics/newton/sort_worlds.cuh"
_SORT_TEXT = headers.text_of(_SORT)


@wp.func_native(headers.call_of(_SORT, (), headers.arguments_of(_SORT_TEXT)))
def sort_by_counting(order: wp.array[int], iterations: wp.array[int], rows: wp.array[int]) -> None:
    """Write the worlds in the order of their keys."""


@wp.kernel(
    module="unique",
    enable_backward=False,
    grid_stride=False,
    module_options={
        "block_dim": SORTING_THREADS,
        "extra_build_options": with_preamble(_SORT_TEXT),
    },
)
def sort_worlds(order: wp.array[int], iterations: wp.array[int], rows: wp.array[int]):
    """Write the order of the worlds, by one block."""
    sort_by_counting(order, iterations, rows)


def put_longest_first(order: wp.array[int], warp_data_E: mjw.Data) -> None:
    """Let a GPU take up those worlds first which will take longest, by their last iterations and their rows.

    A world that takes three times as long as most would otherwise start late and leave the GPU waiting for it alone.
    """
    inputs = [order, warp_data_E.solver_niter, warp_data_E.nefc]
    wp.launch(sort_worlds, dim=SORTING_THREADS, inputs=inputs, block_dim=SORTING_THREADS)
