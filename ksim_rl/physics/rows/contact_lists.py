"""This module lists each world's contacts in one order, whatever their places in the pool that all worlds share.

MuJoCo Warp's threads take places in the pool as they come, otherwise in each run on a GPU.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false

import functools
from importlib.resources import files
from typing import Any

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import upstream
from ksim_rl.physics.structs import filled, struct_with

# Lanes of a world on CUDA, and threads of a block, which shares nothing.
LANES, CUDA_THREADS = 16, 128
HAS_ROWS = wp.constant(int(upstream.ContactType.CONSTRAINT))


class ContactLists:
    """Each world's contacts that may have constraint rows, in the order of MuJoCo's C engine.

    Those in the gap of a margin, which have none, are among them. A world that has more contacts than `room`, by
    default enough for `njmax` rows, leaves out those that happen to come last. Models with flexes have no lists.

    Attributes:
        count, ids: int32 [E], how many contacts a world has, and [E, room], their places in the pool.
    """

    count: wp.array[int]
    ids: wp.array2d[int]
    appended: wp.array[int]
    found: wp.array2d[int]
    keys: wp.array2d[wp.uint64]

    def __init__(self, warp_model: mjw.Model, warp_data_E: mjw.Data, *, room: int | None = None) -> None:
        m, d, device = warp_model, warp_data_E, warp_data_E.qpos.device
        # Each contact but those in a gap takes a row at least.
        gaps = any(gap.numpy().any() for gap in (m.geom_gap, m.pair_gap))
        self.room = room or max(1, d.njmax + (d.naconmax // d.nworld if gaps else 0))
        self.count, self.appended = (wp.zeros(d.nworld, dtype=int, device=device) for _ in range(2))
        self.ids, self.found = (wp.zeros((d.nworld, self.room), dtype=int, device=device) for _ in range(2))
        self.keys = wp.empty((d.nworld, self.room), dtype=wp.uint64, device=device)
        lanes = LANES if device.is_cuda else 1
        self.constants = {"room": self.room, "sdf": bool(m.has_sdf_geom), "lanes": lanes}
        contacts = {f"contact_{name}": array for name, array in vars(d.contact).items()}
        self._problem, self._naconmax = filled(Problem, self, contacts, m, d), d.naconmax

    def append(self) -> None:
        """Launch the first half, after a collision pass: the lists in any order."""
        wp.launch(append_contacts, dim=self._naconmax, inputs=[self._problem], device=self.count.device)

    def order(self) -> None:
        """Launch the second half, where no kernel of constraint rows does so on its way."""
        launch(("layout", "order"), self.constants, Problem, self._problem, self.count)


@struct_with(
    ("", ContactLists, "count ids appended found keys"),
    ("", mjw.Model, "geom_bodyid"),
    ("", mjw.Data, "nacon"),
    ("contact_", mjw.Contact, "geom type worldid dist pos"),
)
class Problem:
    """What the kernels read of the pool, and the lists."""


@wp.kernel(enable_backward=False)
def append_contacts(p: Problem):
    """Append a contact of the pool to its world's list."""
    contact = wp.tid()
    if contact < p.nacon[0] and (p.contact_type[contact] & HAS_ROWS) != 0:
        world = p.contact_worldid[contact]
        place = wp.atomic_add(p.appended, world, 1)
        if place < p.found.shape[1]:
            p.found[world, place] = contact


def launch(
    parts: tuple[str, ...], constants: dict[str, int], struct: Any, problem: Any, count: wp.array
) -> None:
    """Launch C++ parts of this folder, compiled with constants, over the worlds and lanes of a problem."""
    threads, dim = CUDA_THREADS if count.device.is_cuda else 1, (count.size, constants["lanes"])
    kernel = _kernel(parts, tuple(constants.items()), struct, threads)
    wp.launch(kernel, dim=dim, inputs=[problem], block_dim=threads, device=count.device)


@functools.cache
def _kernel(
    parts: tuple[str, ...], constants: tuple[tuple[str, int], ...], struct: Any, threads: int
) -> wp.Kernel:
    folder = files("ksim_rl.physics.rows")
    snippet = "".join(f"constexpr int {name.upper()} = {int(value)};\n" for name, value in constants)
    snippet += "".join(folder.joinpath(f"{part}.cpp").read_text() for part in parts)

    @wp.func_native(snippet)
    def body(world: int, lane: int, problem: struct) -> None: ...

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, module_options={"block_dim": threads}
    )
    def kernel(problem: struct):
        world, lane = wp.tid()
        body(world, lane, problem)

    return kernel
