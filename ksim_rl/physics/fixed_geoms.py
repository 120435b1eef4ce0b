"""Places the geoms that are fixed to the world, where a field that moves them differs between worlds.

MuJoCo Warp, and our kernel of the kinematics, leave them where `make_data` has put them, which is one place for all.
"""

# Kernels only look like Python: wp.tid() returns as many indices as are unpacked.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

from collections.abc import Callable, Collection

import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics.upstream import mul_quat, quat_to_mat, rot_vec_quat

FIELDS = frozenset(("body_pos", "body_quat", "geom_pos", "geom_quat"))


def fixed_geoms(warp_model: mjw.Model) -> np.ndarray:
    """Return which geoms are of the world or of bodies welded to it, bool [ngeom]; mocap bodies move."""
    m = warp_model
    body = m.geom_bodyid.numpy()
    is_fixed = m.body_weldid.numpy() == 0
    # A mocap body is welded to the world in the tree, but is moved.
    is_fixed &= m.body_mocapid.numpy()[m.body_rootid.numpy()] == -1
    return is_fixed[body]


def placing_of_fixed_geoms(
    warp_model: mjw.Model, warp_data_E: mjw.Data, expanded: Collection[str]
) -> Callable[[], None] | None:
    """Return a launcher of the placing, with arrays in their final place; None where no `expanded` field moves any."""
    m = warp_model
    d = warp_data_E
    ids = np.flatnonzero(fixed_geoms(m))
    if not FIELDS.intersection(expanded) or not ids.size:
        return None
    geoms = wp.array(ids, dtype=int, device=d.qpos.device)
    inputs = [
        m.body_parentid,
        m.geom_bodyid,
        geoms,
        m.body_pos,
        m.body_quat,
        m.geom_pos,
        m.geom_quat,
    ]

    def place() -> None:
        outputs = [d.geom_xpos, d.geom_xmat]
        wp.launch(place_fixed_geoms, dim=(d.nworld, ids.size), inputs=inputs, outputs=outputs)

    return place


@wp.kernel(enable_backward=False)
def place_fixed_geoms(
    body_parentid: wp.array[int],
    geom_bodyid: wp.array[int],
    geoms: wp.array[int],
    body_pos: wp.array2d[wp.vec3],
    body_quat: wp.array2d[wp.quat],
    geom_pos: wp.array2d[wp.vec3],
    geom_quat: wp.array2d[wp.quat],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
):
    """Pass each geom's pose on from its body to the world; no joint is on the way."""
    world, item = wp.tid()
    geom = geoms[item]
    pos = geom_pos[world % geom_pos.shape[0], geom]
    quat = geom_quat[world % geom_quat.shape[0], geom]
    body = geom_bodyid[geom]
    # From the geom's body up to the world.
    while body > 0:
        # As kinematics has it, which makes the quaternion of each body one of unit length.
        turn = wp.normalize(body_quat[world % body_quat.shape[0], body])
        pos = body_pos[world % body_pos.shape[0], body] + rot_vec_quat(pos, turn)
        quat = mul_quat(turn, quat)
        body = body_parentid[body]
    geom_xpos[world, geom] = pos
    geom_xmat[world, geom] = quat_to_mat(quat)
