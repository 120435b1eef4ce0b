"""This module lists each world's contacts in one order, whatever their places in the pool that all worlds share.

MuJoCo Warp's threads take places in the pool as they come, otherwise in each run on a GPU.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false, reportIndexIssue=false

import functools
from collections.abc import Callable
from importlib.resources import files

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import upstream
from ksim_rl.physics.structs import filled, struct_with

CUDA_THREADS = 32
CONSTRAINT = wp.constant(int(upstream.ContactType.CONSTRAINT))
# A key has 16 bits for each body and geom of a pair.
MOST_GEOMS = 1 << 16


@struct_with(
    ("", mjw.Model, "geom_bodyid"),
    ("", mjw.Data, "nacon"),
    ("contact_", mjw.Contact, "geom type worldid dist pos"),
)
class Problem:
    """What the kernels read of the pool, the lists that they write, and what was appended until it is ordered."""

    appended: wp.array[int]
    found: wp.array2d[int]
    keys: wp.array2d[wp.uint64]
    count: wp.array[int]
    ids: wp.array2d[int]


class ContactLists:
    """Each world's contacts that may have constraint rows, as MuJoCo's C engine orders them.

    The model has no flexes and at most `MOST_GEOMS` geoms. Contacts in a margin's gap, which have no rows, are among
    them. In a world that finds more contacts than `room`, those that happen to come last are left out.

    Attributes:
        count: int32 [E], how many contacts are in a list.
        ids: int32 [E, room], their places in the pool.
        room: by default as many as there are constraint rows, of which each contact takes one at least, and where
            there are gaps a world's share of the pool besides.
    """

    def __init__(self, warp_model: mjw.Model, warp_data_E: mjw.Data, *, room: int | None = None) -> None:
        m, d = warp_model, warp_data_E
        gaps = any(gap.numpy().any() for gap in (m.geom_gap, m.pair_gap))
        self.room = max(1, d.njmax + (d.naconmax // d.nworld if gaps else 0)) if room is None else room
        self.has_sdf = bool(m.has_sdf_geom)
        device, shape = d.qpos.device, (d.nworld, self.room)
        self.count = wp.zeros(d.nworld, dtype=int, device=device)
        self.ids = wp.zeros(shape, dtype=int, device=device)
        self.arrays = {
            "count": self.count,
            "ids": self.ids,
            "appended": wp.zeros(d.nworld, dtype=int, device=device),
            "found": wp.empty(shape, dtype=int, device=device),
            "keys": wp.empty(shape, dtype=wp.uint64, device=device),
        }
        contacts = {f"contact_{name}": array for name, array in vars(d.contact).items()}
        self._problem = filled(Problem, self.arrays, contacts, m, d)
        self._naconmax = d.naconmax

    def append(self) -> None:
        """Launch the first half, after a collision pass: each world's contacts, which then have to be ordered."""
        wp.launch(append_contacts, dim=self._naconmax, inputs=[self._problem], device=self.count.device)


def ordering(lists: ContactLists) -> Callable[[], None]:
    """Return what launches the second half alone, where no kernel of constraint rows does it on its way."""
    device = lists.count.device
    threads = lanes = CUDA_THREADS if device.is_cuda else 1
    kernel = _ordering_kernel(lists.room, lists.has_sdf, lanes, threads)
    problem, dim = lists._problem, (lists.count.shape[0], lanes)
    return lambda: wp.launch(kernel, dim=dim, inputs=[problem], block_dim=threads, device=device)


@wp.kernel(enable_backward=False)
def append_contacts(p: Problem):
    """Append a contact of the pool to its world's list, at any place."""
    contact = wp.tid()
    if contact >= p.nacon[0] or (p.contact_type[contact] & CONSTRAINT) == 0:
        return
    world = p.contact_worldid[contact]
    place = wp.atomic_add(p.appended, world, 1)
    if place >= p.found.shape[1]:
        return
    p.found[world, place] = contact
    geom, other = p.contact_geom[contact][0], p.contact_geom[contact][1]
    body, other_body = p.geom_bodyid[geom], p.geom_bodyid[other]
    bodies = wp.uint64(wp.min(body, other_body)) << wp.uint64(16) | wp.uint64(wp.max(body, other_body))
    geoms = wp.uint64(wp.min(geom, other)) << wp.uint64(16) | wp.uint64(wp.max(geom, other))
    p.keys[world, place] = bodies << wp.uint64(32) | geoms


def source(*parts: str, **constants: int) -> str:
    """Return the C++ of a kernel: its constants, and its parts in their order."""
    folder = files("ksim_rl.physics.rows")
    lines = "".join(f"constexpr int {name.upper()} = {int(value)};\n" for name, value in constants.items())
    return lines + "".join(folder.joinpath(f"{part}.cpp").read_text() for part in parts)


@functools.cache
def _ordering_kernel(room: int, has_sdf: bool, lanes: int, threads: int) -> wp.Kernel:
    snippet = source("layout", "order", room=room, sdf=has_sdf, lanes=lanes)

    @wp.func_native(snippet)
    def order_contacts(world: int, lane: int, problem: Problem) -> None: ...

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, module_options={"block_dim": threads}
    )
    def kernel(problem: Problem):
        world, lane = wp.tid()
        order_contacts(world, lane, problem)

    return kernel
