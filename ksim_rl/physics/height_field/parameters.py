"""Returns the parameters of contacts with height fields, for both of their kernels."""

# Kernels are Python only in their spelling.
# pyright: reportIndexIssue=false, reportCallIssue=false, reportAttributeAccessIssue=false

from typing import Any

import warp as wp

from ksim_rl.physics.upstream import contact_params


@wp.func
def params_of(c: Any, pair: int, world: int):
    """Return the parameters of contacts of a pair, as MuJoCo Warp has them: margin and gap are the second and third.

    `c` is the struct of a kernel, with the arrays of `fields.MODEL_FIELDS`, and its pairs.
    """
    ground = c.pairs[pair][0]
    geom = c.pairs[pair][1]
    geoms, margin, gap, condim, friction, solref, solreffriction, solimp, adhesion = contact_params(
        c.geom_condim,
        c.geom_priority,
        c.geom_solmix,
        c.geom_solref,
        c.geom_solimp,
        c.geom_friction,
        c.geom_margin,
        c.geom_gap,
        c.geom_adhesion,
        c.pair_dim,
        c.pair_solref,
        c.pair_solreffriction,
        c.pair_solimp,
        c.pair_margin,
        c.pair_gap,
        c.pair_adhesion,
        c.pair_friction,
        c.pairs,
        c.pair_ids,
        pair,
        world,
    )
    if c.pair_ids[pair][0] < 0 and c.geom_priority[ground] != c.geom_priority[geom]:
        # The parameters of the geom with priority hold alone, which MuJoCo Warp's function does not know of this one.
        stronger = wp.where(c.geom_priority[ground] > c.geom_priority[geom], ground, geom)
        solref = c.geom_solref[world % c.geom_solref.shape[0], stronger]
    return geoms, margin, gap, condim, friction, solref, solreffriction, solimp, adhesion
