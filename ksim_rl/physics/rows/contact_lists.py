"""This module lists each world's contacts in one order, whatever their places in the pool that all worlds share.

MuJoCo Warp's threads take places in the pool as they come, otherwise in each run on a GPU.
"""

# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import native, upstream

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

    def __init__(self, warp_model: mjw.Model, warp_data_E: mjw.Data, *, room: int | None = None) -> None:
        m, d, device = warp_model, warp_data_E, warp_data_E.qpos.device
        # Each contact but those in a gap takes a row at least.
        gaps = any(gap.numpy().any() for gap in (m.geom_gap, m.pair_gap))
        self.room = room or max(1, d.njmax + (d.naconmax // d.nworld if gaps else 0))
        self.count, self.appended = (wp.zeros(d.nworld, dtype=int, device=device) for _ in range(2))
        self.ids, self.found = (wp.zeros((d.nworld, self.room), dtype=int, device=device) for _ in range(2))
        self.keys = wp.empty((d.nworld, self.room), dtype=wp.uint64, device=device)
        # For the kernels that read them, too.
        self.constants = {"room": self.room, "sdf": bool(m.has_sdf_geom)}
        self.lanes, self.threads = (LANES, CUDA_THREADS) if device.is_cuda else (1, 1)
        source = native.source_of("rows", ("layout", "order"))
        self._order = native.launcher(
            source, self.constants, vars(self), m, d, lanes=self.lanes, threads=self.threads
        )
        self._pool = [d.nacon, d.contact.type, d.contact.worldid]

    def append(self) -> None:
        """Launch the first half, after a collision pass: the lists in any order."""
        nacon, kind, world = self._pool
        inputs, device = [nacon, kind, world, self.appended, self.found], self.count.device
        wp.launch(append_contacts, dim=kind.size, inputs=inputs, device=device)

    def order(self) -> None:
        """Launch the second half, where no kernel of constraint rows does so on its way."""
        self._order()


@wp.kernel(enable_backward=False)
def append_contacts(
    nacon: wp.array[int],
    kind: wp.array[int],
    world_of: wp.array[int],
    appended: wp.array[int],
    found: wp.array2d[int],
):
    """Append a contact of the pool to its world's list."""
    contact = wp.tid()
    if contact < nacon[0] and (kind[contact] & HAS_ROWS) != 0:
        world = world_of[contact]
        place = wp.atomic_add(appended, world, 1)
        if place < found.shape[1]:
            found[world, place] = contact
