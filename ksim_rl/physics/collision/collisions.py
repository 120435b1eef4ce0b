"""This module launches the collision pass of a substep, with a broad phase of our own before MuJoCo Warp's narrow one.

MuJoCo Warp's has a thread for each pair of geoms, and each that passes waits for the one counter of all worlds.
"""

from collections.abc import Callable

import mujoco_warp as mjw

from ksim_rl.physics import native, upstream

# Lanes of a world on CUDA, and threads of a block, which shares nothing.
LANES, CUDA_THREADS = 32, 128
FILTERS = mjw.BroadphaseFilter.PLANE | mjw.BroadphaseFilter.SPHERE | mjw.BroadphaseFilter.OBB


def broad_phase_unavailable(
    warp_model: mjw.Model, warp_data_E: mjw.Data, *, rows_unavailable: str | None = None
) -> str | None:
    """Return why MuJoCo Warp's own broad phase finds a model's pairs, or None where ours does.

    Contacts stand in another order then, which rows by one kernel do not depend on.
    """
    m, opt, bits = warp_model, warp_model.opt, mjw.DisableBit
    reasons = {
        "the rows of contacts are not made by one kernel": rows_unavailable is not None,
        "no contacts are wanted": bool(opt.disableflags & (bits.CONSTRAINT | bits.CONTACT)),
        "there is no room for contacts": warp_data_E.naconmax == 0,
        "it sweeps and prunes, or by other filters": (opt.broadphase, opt.broadphase_filter)
        != (mjw.BroadphaseType.NXN, FILTERS),
        "worlds may sleep": bool(opt.enableflags & mjw.EnableBit.SLEEP),
        "there are flexes": m.nflex > 0,
        "surfaces move": bool(m.flg_surfacevel),
        "worlds have other meshes": m.geom_dataid.shape[0] > 1,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def collisions(
    warp_model: mjw.Model, warp_data_E: mjw.Data, *, lanes: int | None = None
) -> Callable[[], None]:
    """Return what launches `mjw.collision` for a model for which it is available, with arrays in their final place.

    It finds the same contacts; their places in the pool that all worlds share are others, as they are on a GPU in each
    run. `lanes` is how many threads share a world on CUDA; None takes the usual.
    """
    m, d = warp_model, warp_data_E
    context = upstream.create_collision_context(d.naconmax)
    aabb = m.geom_aabb
    own = vars(context) | {"geom_boxes": aabb.reshape((aabb.shape[0], -1))}
    on_gpu = d.qpos.device.is_cuda
    source = native.source_of("rows", ("layout",)) + native.source_of("collision", ("broad_phase",))
    lanes, threads = (lanes or LANES, CUDA_THREADS) if on_gpu else (1, 1)
    margins = m.geom_margin, m.geom_gap, m.pair_margin, m.pair_gap
    constants = {
        # Those of each world's own may be drawn at any time.
        "has_margins": any(field.shape[0] > 1 or bool(field.numpy().any()) for field in margins),
        "measures": bool((m.nxn_pairid_filtered.numpy()[:, 1] > upstream.NO_SENSOR).any()),
    }
    find_pairs = native.launcher(source, constants, own, m, d, lanes=lanes, threads=threads)

    def launch() -> None:
        d.ncollision.zero_()
        d.nacon.zero_()
        find_pairs()
        upstream.narrowphase(m, d, context)
        if m.callback.contactfilter:
            m.callback.contactfilter(m, d)

    return launch
