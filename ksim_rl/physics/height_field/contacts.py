"""Height fields collide through a kernel of our own instead of MuJoCo Warp's general convex one.

MuJoCo Warp (4.0) treats each triangle as the top of a prism and runs GJK and EPA on it. Where a prism's top is not
level, some contacts (about one in 25 of a small ball on a slope or on rough ground) get a depth of centimetres and a
normal straight up or down, which kicks robots. A ball, a capsule or a box against triangles needs no such search: our
kernel is exact, and cheaper.
"""

from __future__ import annotations

import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import upstream
from ksim_rl.physics.height_field.kernels import BOX, CAPSULE, SPHERE, height_field_contacts
from ksim_rl.physics.launch import launch_by_name

HEIGHT_FIELD = int(mjw.GeomType.HFIELD)
_SHAPES = (SPHERE, CAPSULE, BOX)


def take_over_height_fields(warp_model: mjw.Model) -> None:
    """Let our kernel find the contacts of height fields with spheres, capsules and boxes, in place.

    Pairs with other geoms (cylinders, ellipsoids, meshes), and pairs that a distance sensor measures, stay with MuJoCo
    Warp. Call it before anything copies the model.
    """
    geom_type = warp_model.geom_type.numpy()
    pairs, pair_ids = upstream.geom_pairs(warp_model)
    types = geom_type[pairs]
    height_first = np.where(types[:, :1] == HEIGHT_FIELD, pairs, pairs[:, ::-1])
    taken = (types == HEIGHT_FIELD).any(-1) & np.isin(geom_type[height_first[:, 1]], _SHAPES)
    taken &= (pair_ids[:, 0] > upstream.NO_CONTACT) & (pair_ids[:, 1] == upstream.NO_SENSOR)
    if not taken.any() or warp_model.flg_surfacevel:
        return
    contacts = _Contacts(height_first[taken], pair_ids[taken])
    upstream.drop_pairs(warp_model, taken)
    warp_model.callback.contactfilter = contacts


class _Contacts:
    """The hook that MuJoCo Warp calls after its own collision pass."""

    def __init__(self, pairs: np.ndarray, pair_ids: np.ndarray) -> None:
        self._pairs = wp.array(pairs, dtype=wp.vec2i)
        self._pair_ids = wp.array(pair_ids, dtype=wp.vec2i)

    def __call__(self, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        """Append the contacts of all worlds."""
        own = {"pairs": self._pairs, "pair_ids": self._pair_ids}
        contacts = {f"contact_{name}": array for name, array in vars(warp_data_E.contact).items()}
        dim = (warp_data_E.nworld, len(self._pairs))
        launch_by_name(height_field_contacts, dim, own, contacts, warp_model, warp_data_E)
