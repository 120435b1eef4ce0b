"""Launches the collision pass of a substep: one kernel, which owns a world, and MuJoCo Warp's for the rest.

MuJoCo Warp's has a thread for each pair of geoms, and each that passes waits for the one counter of all worlds, as each
contact does afterwards. The kernel is collisions.cuh.
"""

import dataclasses
from collections.abc import Callable, Iterator

import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import native, upstream
from ksim_rl.physics.contacts import Mending, corrections
from ksim_rl.physics.rows.contact_lists import HAS_ROWS, ContactLists

# Lanes of a world on CUDA, threads of a block, which shares nothing, and registers: as many as let 4096 worlds be on an
# H200 at once. Most of the 103 that the compiler likes are for capsules with boxes, which are few.
LANES = 32
CUDA_THREADS = 128
REGISTERS = 64
FILTERS = mjw.BroadphaseFilter.PLANE | mjw.BroadphaseFilter.SPHERE | mjw.BroadphaseFilter.OBB
TYPES = ("PLANE", "SPHERE", "CAPSULE", "CYLINDER", "BOX")
# How many contacts a pair of these types has at most.
MOST_CONTACTS = {
    "plane": {"sphere": 1, "capsule": 2, "cylinder": 4, "box": 8},
    "sphere": {"sphere": 1, "capsule": 1, "box": 1},
    "capsule": {"capsule": 2, "box": 2},
}


def broad_phase_unavailable(
    warp_model: mjw.Model, warp_data_E: mjw.Data, *, rows_unavailable: str | None = None
) -> str | None:
    """Return why MuJoCo Warp's own broad phase finds a model's pairs, or None where ours does."""
    m = warp_model
    opt = warp_model.opt
    bits = mjw.DisableBit
    reasons = {
        "the rows of contacts are not made by one kernel": rows_unavailable is not None,
        "no contacts are wanted": bool(opt.disableflags & (bits.CONSTRAINT | bits.CONTACT)),
        "there is no room for contacts": warp_data_E.naconmax == 0,
        "it sweeps and prunes, or by other filters": (opt.broadphase, opt.broadphase_filter)
        != (mjw.BroadphaseType.NXN, FILTERS),
        "worlds have other meshes": m.geom_dataid.shape[0] > 1,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def pairs_left(warp_model: mjw.Model) -> str | None:
    """Return whose contacts MuJoCo Warp's narrow phase finds after our broad one, or None."""
    # Types whose contacts our narrow phase does not find have a count of 0.
    left = {" and ".join(kinds) for *_, kinds, most in _pairs(warp_model) if not most}
    if left:
        return f"{', '.join(sorted(left))} meet, whose contacts they alone find"
    return None


def _pairs(warp_model: mjw.Model) -> Iterator[tuple[int, int, list[str], int]]:
    """Yield each pair, the geom of the lower type first, its types, and how many contacts the kernel finds at most."""
    pairs = warp_model.nxn_geom_pair_filtered.numpy()
    types = warp_model.geom_type.numpy()
    for pair, (_, sensor) in zip(
        pairs.tolist(), warp_model.nxn_pairid_filtered.numpy(), strict=True
    ):
        # The lower type first, as in the keys of MOST_CONTACTS.
        a, b = sorted(pair, key=types.__getitem__)
        kinds = [mjw.GeomType(types[geom]).name.lower() for geom in (a, b)]
        # A sensor that measures a pair reads contacts that have no rows, too.
        known = sensor == upstream.NO_SENSOR
        most = 0
        if known:
            most = MOST_CONTACTS.get(kinds[0], {}).get(kinds[1], 0)
        yield a, b, kinds, most


def collisions(
    warp_model: mjw.Model, warp_data_E: mjw.Data, lists: ContactLists, *, lanes: int | None = None
) -> Callable[[], None]:
    """Return a launcher of our collision pass, which replaces `mjw.collision` for models where it is available.

    The launcher keeps the addresses of the arrays. The pool must be empty (`nacon`). The order of contacts in the pool
    differs from MuJoCo Warp's, which on a GPU varies between runs anyway. Contacts are appended to the lists, unless
    MuJoCo Warp or a hook changes the pool afterwards. `lanes` is how many threads share a world on CUDA; None takes the
    usual number.
    """
    m = warp_model
    d = warp_data_E
    device = d.qpos.device
    aabb = m.geom_aabb
    found = [(a, b, most) for a, b, _, most in _pairs(m)]
    pairs = np.array(found, dtype=np.int32).reshape(-1, 3)
    # Pairs that our narrow phase leaves to MuJoCo Warp are handed over by the broad phase.
    are_theirs = pairs[:, 2] == 0
    others = pairs[are_theirs, :2]
    context = upstream.create_collision_context(d.naconmax if others.size else 0)
    own = {
        **vars(context),
        **vars(lists),
        "geom_boxes": aabb.reshape((aabb.shape[0], -1)),
        "pairs": wp.array(pairs, dtype=wp.vec3i, device=device),
        "lists": 1,
    }
    if device.is_cuda:
        lanes = lanes or LANES
        threads = CUDA_THREADS
        build = native.Build(max_registers=REGISTERS)
    # The CPU compiles the same source for one lane.
    else:
        lanes = 1
        threads = 1
        build = native.Build()
    margins = m.geom_margin, m.geom_gap, m.pair_margin, m.pair_gap
    constants = {
        **{name: upstream.GEOM_TYPES[name] for name in TYPES},
        # Margins that differ between worlds may be drawn at any time.
        "has_margins": any(field.shape[0] > 1 or bool(field.numpy().any()) for field in margins),
        "has_pairs": m.pair_dim.size > 0,
        "measures": bool((m.nxn_pairid_filtered.numpy()[:, 1] > upstream.NO_SENSOR).any()),
        "others": others.size > 0,
        "has_rows": HAS_ROWS,
    }
    header = "ksim_rl/physics/collision/collisions.cuh"
    collide = native.launcher_of(
        header, constants, own, m, d, lanes=lanes, threads=threads, build=build
    )
    # MuJoCo Warp's narrow phase launches kernels by these counts: only of the pairs that are left.
    theirs = dataclasses.replace(m, geom_pair_type_count=upstream.pair_type_counts(m, others))
    their_ids = wp.array(m.nxn_pairid_filtered.numpy()[are_theirs], dtype=wp.vec2i, device=device)
    of_theirs = corrections(m, wp.array(others, dtype=wp.vec2i, device=device), their_ids)

    def launch() -> None:
        # The hook is read at each launch, since a program may set a hook, too.
        hook = m.callback.contactfilter
        if isinstance(hook, Mending):
            # Our own contacts need no corrections.
            own_hook = dataclasses.replace(hook, of_theirs=of_theirs)
            hook = own_hook if own_hook.hooks() else None
        # Appended in the collision pass, lists need no second look at the pool; hooks may change it afterwards.
        lists.are_appended = not others.size and hook is None
        if others.size:
            # The counter of pairs that the broad phase hands over.
            d.ncollision.zero_()
        collide(lists=int(lists.are_appended))
        if others.size:
            upstream.narrowphase(theirs, d, context)
        if hook:
            hook(m, d)

    return launch
