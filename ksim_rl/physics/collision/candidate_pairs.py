"""The pairs of geoms that MuJoCo's filters let collide, and how many of them may touch in a pose."""

import mujoco
import numpy as np


class CandidatePairs:
    """Counts the geom pairs whose bounding spheres touch: Warp keeps a place in the contact pool for each of them.

    MuJoCo's filters leave the pairs that may collide at all: contype and conaffinity, not the same rigid body,
    not parent and child, not excluded.
    """

    def __init__(self, mj_model: mujoco.MjModel) -> None:
        self.mj_model = mj_model
        # All pairs of geoms, each once, [N].
        first, second = np.triu_indices(mj_model.ngeom, k=1)
        body_1 = mj_model.geom_bodyid[first]
        body_2 = mj_model.geom_bodyid[second]
        # Bodies that are welded together are one rigid body, which does not collide with itself.
        weld_1 = mj_model.body_weldid[body_1]
        weld_2 = mj_model.body_weldid[body_2]
        parent_1 = mj_model.body_weldid[mj_model.body_parentid[weld_1]]
        parent_2 = mj_model.body_weldid[mj_model.body_parentid[weld_2]]
        one_way = mj_model.geom_contype[first] & mj_model.geom_conaffinity[second]
        other_way = mj_model.geom_contype[second] & mj_model.geom_conaffinity[first]
        affine = one_way | other_way
        # Pairs collide if one's contype meets the other's conaffinity; see MuJoCo's filters.
        keep = (affine != 0) & (weld_1 != weld_2)
        if not mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
            # For this filter the world (0) is no parent, so that robots collide with what is fixed to it.
            both_move = (weld_1 != 0) & (weld_2 != 0)
            are_related = (weld_1 == parent_2) | (weld_2 == parent_1)
            keep &= ~(both_move & are_related)
        keep &= ~np.isin((body_1 << 16) + body_2, mj_model.exclude_signature)
        # Explicit <pair>s come on top, whatever the filters say.
        self.first = np.concatenate([first[keep], mj_model.pair_geom1])
        self.second = np.concatenate([second[keep], mj_model.pair_geom2])
        self.margin = np.maximum(
            mj_model.geom_margin[self.first], mj_model.geom_margin[self.second]
        )
        is_plane = mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self.plane_1 = is_plane[self.first]
        self.plane_2 = is_plane[self.second]
        # A plane has a radius of 0; its distance is measured along the normal below.
        self.reach = (
            mj_model.geom_rbound[self.first] + mj_model.geom_rbound[self.second] + self.margin
        )

    def count(self, mj_data: mujoco.MjData) -> int:
        """Return the number of pairs that may touch in the present pose."""
        if self.first.size == 0:
            return 0
        offset = mj_data.geom_xpos[self.second] - mj_data.geom_xpos[self.first]
        distance = np.linalg.norm(offset, axis=1)
        # The third columns of the rotation matrices: z axes, which are the normals of planes.
        normals = mj_data.geom_xmat[:, [2, 5, 8]]
        distance = np.where(self.plane_1, (offset * normals[self.first]).sum(1), distance)
        distance = np.where(self.plane_2, -(offset * normals[self.second]).sum(1), distance)
        return int(np.count_nonzero(distance <= self.reach))
