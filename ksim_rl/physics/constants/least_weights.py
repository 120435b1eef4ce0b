"""Gives bodies that turn about their centre of mass a weight, without which float32 cannot solve for their contacts.

No joint moves that centre, so that MuJoCo gives the body the inverse weight 0, and a contact with what is fixed the
largest `efc_D` that there is, 1e15. C's own forces there are rounding errors (docs/upstream.md); in float32 bodies fly
off. With a little weight both engines compute the same. Bodies that may touch only what has a weight keep C's.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics.collision.candidate_pairs import CandidatePairs

# Below this, in 1/kg, an inverse weight is rounding error.
ROUNDING = 1e-12
# The least inverse weight of such a body, as a share of 1 / the mass that it carries: its contacts are still harder
# than contacts of other bodies, and forces across the joint so small that float32's rounding of them does little work
# along it.
SHARE = 1e-2


def weightless_pairs(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the geoms that may touch, and of whose contact neither side has a weight though one moves, [N, 2]."""
    contacts_are_off = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if mj_model.opt.disableflags & contacts_are_off or not _weightless(mj_model).any():
        return np.zeros((0, 2), dtype=np.int64)
    candidates = CandidatePairs(mj_model)
    pairs = np.stack([candidates.first, candidates.second], axis=-1)
    bodies = mj_model.geom_bodyid[pairs]
    moves = (mj_model.body_treeid[bodies] >= 0).any(-1)
    have_none = mj_model.body_invweight0[bodies, 0].sum(-1) < ROUNDING
    return pairs[moves & have_none]


def _weightless(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return which bodies move, and have no weight for translation, bool [nbody]."""
    return (mj_model.body_treeid >= 0) & (mj_model.body_invweight0[:, 0] < ROUNDING)


def least_weights(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the least inverse weight of each body, 1/kg, [nbody]: 0 of all but those with `weightless_pairs`."""
    has_none = np.zeros(mj_model.nbody, dtype=bool)
    has_none[mj_model.geom_bodyid[weightless_pairs(mj_model)]] = True
    has_none &= _weightless(mj_model)
    found = np.zeros(mj_model.nbody)
    found[has_none] = SHARE / mj_model.body_subtreemass[has_none]
    return found


def raising_of_weights(mj_model: mujoco.MjModel, warp_model: mjw.Model) -> Callable[[], None]:
    """Return a launcher that gives bodies their least weight, for after all that computes weights."""
    least = least_weights(mj_model)
    if not least.any():
        return _nothing
    table = wp.array(least, dtype=float)
    weights = warp_model.body_invweight0

    def raise_them() -> None:
        wp.launch(raise_weights, dim=weights.shape, inputs=[table], outputs=[weights])

    return raise_them


def _nothing() -> None:
    """Launch nothing."""


@wp.kernel(enable_backward=False)
def raise_weights(least: wp.array[float], body_invweight0: wp.array2d[wp.vec2]):
    """Let no body weigh less than it shall, for translation."""
    row, body = wp.tid()
    weights = body_invweight0[row, body]
    body_invweight0[row, body] = wp.vec2(wp.max(weights[0], least[body]), weights[1])
