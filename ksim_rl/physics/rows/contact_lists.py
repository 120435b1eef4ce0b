"""Lists each world's contacts in one order, whatever their places in the pool that all worlds share.

MuJoCo Warp's threads take places in the pool as they come, otherwise in each run on a GPU.
"""

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import native, upstream

# Lanes of a world on CUDA, and threads of a block, which shares nothing.
LANES = 16
CUDA_THREADS = 64
HAS_ROWS = int(upstream.ContactType.CONSTRAINT)


class ContactLists:
    """Each world's contacts that may have constraint rows, in the order of MuJoCo's C engine.

    Those in the gap of a margin, which have none, are among them. A world that has more contacts than `room`, by
    default enough for `njmax` rows, leaves out those that happen to come last. Models with flexes have no lists.

    Attributes:
        count, ids: int32 [E], how many contacts a world has, and [E, room], their places in the pool.
        are_appended: whether the collision pass launches the first half.
        order: launches the second, where no kernel of constraint rows does so on its way.
    """

    def __init__(
        self, warp_model: mjw.Model, warp_data_E: mjw.Data, *, room: int | None = None
    ) -> None:
        m = warp_model
        d = warp_data_E
        device = warp_data_E.qpos.device
        # Each contact but those in a gap takes a row at least.
        gaps = any(gap.numpy().any() for gap in (m.geom_gap, m.pair_gap))
        self.room = room or max(1, d.njmax + (d.naconmax // d.nworld if gaps else 0))
        self.count, self.appended = (wp.zeros(d.nworld, dtype=int, device=device) for _ in range(2))
        self.ids, self.found = (
            wp.zeros((d.nworld, self.room), dtype=int, device=device) for _ in range(2)
        )
        # Contacts are sorted by these 64 bits, in C's order.
        self.keys = wp.empty((d.nworld, self.room), dtype=wp.uint64, device=device)
        # For the kernel of rows, too, which orders contacts on its way.
        self.constants = {
            "room": self.room,
            "sdf": bool(m.has_sdf_geom),
            "pairs": m.pair_dim.size,
            "repeated_pairs": bool(upstream.repeated_pairs(m).size),
        }
        if device.is_cuda:
            self.lanes = LANES
            self.threads = CUDA_THREADS
        else:
            self.lanes = 1
            self.threads = 1
        given = vars(self), m, d
        lanes = self.lanes
        threads = self.threads
        # The first half appends, the second one sorts.
        has_rows = {"has_rows": HAS_ROWS}
        append = "ksim_rl/physics/rows/contact_append.cuh"
        self._append = native.launcher_of(append, has_rows, *given, lanes=lanes, threads=threads)
        order = "ksim_rl/physics/rows/contact_lists.cuh"
        self.order = native.launcher_of(order, self.constants, *given, lanes=lanes, threads=threads)
        self.are_appended = False

    def append(self) -> None:
        """Launch the first half, after a collision pass that has not: the lists in any order."""
        if not self.are_appended:
            # Counters of the last substep.
            self.appended.zero_()
            self._append()
