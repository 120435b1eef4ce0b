"""These Warp kernels recompute the constants that MuJoCo derives at `qpos0`, in the worlds of a mask only.

The joint-space inertia is factored as M = L^T D L over the tree of dofs (Featherstone, "Rigid Body Dynamics
Algorithms", 2008, section 6.5), and L is inverted row by row. Then J M^-1 J^T = sum_k (J L^-1)_k^2 / D_k for each
Jacobian row, with no further solve. One matrix [nv, nv] per world holds D on its diagonal, L below and L^-1 above
(transposed); entries of dofs that are not on one chain stay zero.

Few worlds reset at a time, so that what counts is how long one takes: the lanes of a warp share its work.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.structs import struct_with
from ksim_rl.physics.upstream import mul_quat, quat_to_mat, rot_vec_quat

FREE = wp.constant(int(mujoco.mjtJoint.mjJNT_FREE))
BALL = wp.constant(int(mujoco.mjtJoint.mjJNT_BALL))
MINVAL = wp.constant(float(mujoco.mjMINVAL))
KIN0 = wp.constant(int(mjw.SetConstGroup.KIN0))
INERT0 = wp.constant(int(mjw.SetConstGroup.INERT0))


@struct_with(
    (
        "",
        mjw.Model,
        "nbody nv ncam nlight qpos0 body_parentid body_jntnum body_jntadr body_subtreenum body_pos body_quat body_mass "
        "body_inertia body_ipos body_iquat body_subtreemass body_invweight0 "
        "jnt_type jnt_qposadr jnt_dofadr jnt_pos jnt_axis "
        "dof_bodyid dof_parentid dof_armature dof_invweight0 actuator_armature actuator_gear actuator_acc0 "
        "cam_bodyid cam_targetbodyid cam_pos cam_quat cam_pos0 cam_poscom0 cam_mat0 light_bodyid "
        "light_targetbodyid light_pos light_dir light_pos0 light_poscom0 light_dir0",
    )
)
class Constants:
    """What the kernels read of a model and write into it, and their own memory; `axis` and `anchor` are per dof."""

    mask: wp.array[bool]
    sums_masses: bool
    num_actuators: int
    dof_rotates: wp.array[float]
    group_start: wp.array[int]
    group_size: wp.array[int]
    last_dof: wp.array[int]
    actuator_dof: wp.array[int]
    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]
    anchor: wp.array2d[wp.vec3]
    axis: wp.array2d[wp.vec3]
    xipos: wp.array2d[wp.vec3]
    inertia: wp.array2d[wp.mat33]
    factor: wp.array3d[float]


@wp.func
def _point_velocity(rotates: float, axis: wp.vec3, anchor: wp.vec3, point: wp.vec3) -> wp.vec3:
    """Velocity of a point when its dof moves at unit speed."""
    return rotates * wp.cross(axis, point - anchor) + (1.0 - rotates) * axis


@wp.kernel(enable_backward=False)
def frames(c: Constants):
    """Body frames, and each dof's axis and anchor, at `qpos0`: there, hinges and slides do not move anything."""
    world = wp.tid()
    if not c.mask[world]:
        return
    c.xpos[world, 0] = wp.vec3(0.0, 0.0, 0.0)
    c.xquat[world, 0] = wp.quat(1.0, 0.0, 0.0, 0.0)
    for body in range(1, c.nbody):
        parent = c.body_parentid[body]
        turn = c.xquat[world, parent]
        pos = c.xpos[world, parent] + rot_vec_quat(c.body_pos[world % c.body_pos.shape[0], body], turn)
        quat = mul_quat(turn, c.body_quat[world % c.body_quat.shape[0], body])
        for joint in range(c.body_jntadr[body], c.body_jntadr[body] + c.body_jntnum[body]):
            kind = c.jnt_type[joint]
            dof = c.jnt_dofadr[joint]
            q = c.jnt_qposadr[joint]
            row = world % c.qpos0.shape[0]
            pivot = c.jnt_pos[world % c.jnt_pos.shape[0], joint]
            if kind == FREE:
                pos = wp.vec3(c.qpos0[row, q], c.qpos0[row, q + 1], c.qpos0[row, q + 2])
                quat = wp.normalize(
                    wp.quat(
                        c.qpos0[row, q + 3], c.qpos0[row, q + 4], c.qpos0[row, q + 5], c.qpos0[row, q + 6]
                    )
                )
                for i in range(3):
                    unit = wp.vec3(0.0, 0.0, 0.0)
                    unit[i] = 1.0
                    c.axis[world, dof + i] = unit
                    c.anchor[world, dof + i] = pos
                    c.axis[world, dof + 3 + i] = rot_vec_quat(unit, quat)
                    c.anchor[world, dof + 3 + i] = pos
            elif kind == BALL:
                place = pos + rot_vec_quat(pivot, quat)
                turned = wp.quat(
                    c.qpos0[row, q], c.qpos0[row, q + 1], c.qpos0[row, q + 2], c.qpos0[row, q + 3]
                )
                quat = mul_quat(quat, wp.normalize(turned))
                pos = place - rot_vec_quat(pivot, quat)
                for i in range(3):
                    unit = wp.vec3(0.0, 0.0, 0.0)
                    unit[i] = 1.0
                    c.axis[world, dof + i] = rot_vec_quat(unit, quat)
                    c.anchor[world, dof + i] = place
            else:
                c.anchor[world, dof] = pos + rot_vec_quat(pivot, quat)
                c.axis[world, dof] = rot_vec_quat(c.jnt_axis[world % c.jnt_axis.shape[0], joint], quat)
        c.xpos[world, body] = pos
        c.xquat[world, body] = wp.normalize(quat)


@wp.func
def _add_up_body(world: int, body: int, c: Constants):
    """The mass of all that hangs on a body, its centre of mass, and its inertia about that, in the world frame."""
    mass = float(0.0)  # noqa: UP018 (Warp: a variable that changes in a loop)
    for other in range(body, body + c.body_subtreenum[body]):
        mass += c.body_mass[world % c.body_mass.shape[0], other]
    if c.sums_masses:
        c.body_subtreemass[world, body] = mass
    frame = world % c.xpos.shape[0]
    turn = c.xquat[frame, body]
    c.xipos[world, body] = c.xpos[frame, body] + rot_vec_quat(
        c.body_ipos[world % c.body_ipos.shape[0], body], turn
    )
    axes = quat_to_mat(mul_quat(turn, c.body_iquat[world % c.body_iquat.shape[0], body]))
    moments = c.body_inertia[world % c.body_inertia.shape[0], body]
    c.inertia[world, body] = axes @ wp.diag(moments) @ wp.transpose(axes)


@wp.func
def _mass_matrix_row(world: int, dof: int, c: Constants):
    """Row `dof` of M: what the momentum of its subtree, moved at unit speed, is along the dofs of its chain."""
    frame = world % c.axis.shape[0]
    first = c.dof_bodyid[dof]
    point = c.xipos[world, first]
    rotates = c.dof_rotates[dof]
    turning = rotates * c.axis[frame, dof]
    momentum = wp.vec3(0.0, 0.0, 0.0)
    spin = wp.vec3(0.0, 0.0, 0.0)
    for body in range(first, first + c.body_subtreenum[first]):
        com = c.xipos[world, body]
        velocity = _point_velocity(rotates, c.axis[frame, dof], c.anchor[frame, dof], com)
        part = c.body_mass[world % c.body_mass.shape[0], body] * velocity
        momentum += part
        spin += c.inertia[world, body] @ turning + wp.cross(com - point, part)
    armature = float(c.dof_armature[world % c.dof_armature.shape[0], dof])
    for i in range(c.num_actuators):
        if c.actuator_dof[i] == dof:
            gear = c.actuator_gear[world % c.actuator_gear.shape[0], i][0]
            armature += c.actuator_armature[world % c.actuator_armature.shape[0], i] * gear * gear
    other = dof
    while other >= 0:
        along = c.dof_rotates[other]
        velocity = _point_velocity(along, c.axis[frame, other], c.anchor[frame, other], point)
        c.factor[world, dof, other] = (
            wp.dot(momentum, velocity) + along * wp.dot(spin, c.axis[frame, other]) + armature
        )
        armature = 0.0
        other = c.dof_parentid[other]


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def _wait_for_all() -> None:
    """Let the lanes of a world see what all have written."""


@wp.func
def _ancestor(dof: int, steps: int, c: Constants) -> int:
    """Return the dof that is so many steps closer to the root, -1 beyond it."""
    found = int(dof)
    for _ in range(steps):
        if found >= 0:
            found = c.dof_parentid[found]
    return found


@wp.func
def _factorize(world: int, lane: int, lanes: int, c: Constants):
    """M = L^T D L, in place, from the leaves to the root; each lane has some ancestors of a dof."""
    for step in range(c.nv):
        k = c.nv - 1 - step
        inverse = 1.0 / c.factor[world, k, k]
        i = _ancestor(k, lane + 1, c)
        while i >= 0:
            ratio = c.factor[world, k, i] * inverse
            j = int(i)
            while j >= 0:
                c.factor[world, i, j] = c.factor[world, i, j] - ratio * c.factor[world, k, j]
                j = c.dof_parentid[j]
            i = _ancestor(i, lanes, c)
        _wait_for_all()
        i = _ancestor(k, lane + 1, c)
        while i >= 0:
            c.factor[world, k, i] = c.factor[world, k, i] * inverse
            i = _ancestor(i, lanes, c)
    _wait_for_all()


@wp.func
def _invert_row(world: int, dof: int, c: Constants):
    """Row `dof` of X = L^-1, from X L = 1; X[dof, k] is kept at [k, dof]."""
    k = c.dof_parentid[dof]
    while k >= 0:
        total = float(c.factor[world, dof, k])
        j = c.dof_parentid[dof]
        while j > k:
            total += c.factor[world, j, dof] * c.factor[world, j, k]
            j = c.dof_parentid[j]
        c.factor[world, k, dof] = -total
        k = c.dof_parentid[k]


@wp.func
def _dof_invweight(world: int, dof: int, c: Constants):
    """Diagonal of M^-1, averaged over the translations and over the rotations of one joint."""
    total = float(0.0)  # noqa: UP018
    for member in range(c.group_start[dof], c.group_start[dof] + c.group_size[dof]):
        total += 1.0 / c.factor[world, member, member]
        k = c.dof_parentid[member]
        while k >= 0:
            total += c.factor[world, k, member] * c.factor[world, k, member] / c.factor[world, k, k]
            k = c.dof_parentid[k]
    c.dof_invweight0[world % c.dof_invweight0.shape[0], dof] = total / float(c.group_size[dof])


@wp.func
def _body_invweight(world: int, body: int, c: Constants):
    """Mean diagonal of J M^-1 J^T at each centre of mass: translation, rotation."""
    frame = world % c.axis.shape[0]
    point = c.xipos[world, body]
    moved = float(0.0)  # noqa: UP018
    turned = float(0.0)  # noqa: UP018
    k = c.last_dof[body]
    while k >= 0:
        linear = wp.vec3(0.0, 0.0, 0.0)
        angular = wp.vec3(0.0, 0.0, 0.0)
        i = c.last_dof[body]
        while i >= k:
            share = float(1.0)  # noqa: UP018
            if i > k:
                share = c.factor[world, k, i]
            linear += share * _point_velocity(c.dof_rotates[i], c.axis[frame, i], c.anchor[frame, i], point)
            angular += share * c.dof_rotates[i] * c.axis[frame, i]
            i = c.dof_parentid[i]
        moved += wp.dot(linear, linear) / c.factor[world, k, k]
        turned += wp.dot(angular, angular) / c.factor[world, k, k]
        k = c.dof_parentid[k]
    # As in C: a body that only slides has 0 for rotation, where mujoco_warp.set_const takes the other figure.
    c.body_invweight0[world % c.body_invweight0.shape[0], body] = wp.vec2(moved / 3.0, turned / 3.0)


@wp.func
def _actuator_acceleration(world: int, actuator: int, c: Constants):
    """Norm of the acceleration from unit force: of column `actuator_dof` of M^-1, times the gear."""
    dof = c.actuator_dof[actuator]
    total = float(0.0)  # noqa: UP018
    for other in range(c.nv):
        entry = float(0.0)  # noqa: UP018
        k = dof
        while k >= 0:
            left = float(1.0)  # noqa: UP018
            right = float(0.0)  # noqa: UP018
            if k < dof:
                left = c.factor[world, k, dof]
            if k == other:
                right = 1.0
            elif k < other:
                right = c.factor[world, k, other]
            entry += left * right / c.factor[world, k, k]
            k = c.dof_parentid[k]
        total += entry * entry
    gear = c.actuator_gear[world % c.actuator_gear.shape[0], actuator][0]
    c.actuator_acc0[world % c.actuator_acc0.shape[0], actuator] = wp.abs(gear) * wp.sqrt(total)


@wp.func
def _subtree_com(world: int, body: int, c: Constants) -> wp.vec3:
    moment = wp.vec3(0.0, 0.0, 0.0)
    total = float(0.0)  # noqa: UP018
    for other in range(body, body + c.body_subtreenum[body]):
        mass = c.body_mass[world % c.body_mass.shape[0], other]
        moment += mass * c.xipos[world, other]
        total += mass
    if total < MINVAL:
        return c.xipos[world, body]
    return moment / total


@wp.func
def _references(world: int, body: int, target: int, pos: wp.vec3, c: Constants):
    """Return a place on a body from that body and from the centre of mass that it tracks, world axes, m."""
    frame = world % c.xpos.shape[0]
    tracked = wp.where(target < 0, body, target)
    offset = rot_vec_quat(pos, c.xquat[frame, body])
    return offset, c.xpos[frame, body] + offset - _subtree_com(world, tracked, c)


@wp.func
def _camera_reference(world: int, camera: int, c: Constants):
    """Where cameras are at `qpos0`: from their body, and from the centre of mass that they track."""
    body = c.cam_bodyid[camera]
    pos = c.cam_pos[world % c.cam_pos.shape[0], camera]
    offset, from_com = _references(world, body, c.cam_targetbodyid[camera], pos, c)
    turn = c.xquat[world % c.xpos.shape[0], body]
    c.cam_pos0[world % c.cam_pos0.shape[0], camera] = offset
    c.cam_poscom0[world % c.cam_poscom0.shape[0], camera] = from_com
    c.cam_mat0[world % c.cam_mat0.shape[0], camera] = quat_to_mat(
        mul_quat(turn, c.cam_quat[world % c.cam_quat.shape[0], camera])
    )


@wp.func
def _light_reference(world: int, light: int, c: Constants):
    """Where lights are at `qpos0`: from their body, and from the centre of mass that they track."""
    body = c.light_bodyid[light]
    pos = c.light_pos[world % c.light_pos.shape[0], light]
    offset, from_com = _references(world, body, c.light_targetbodyid[light], pos, c)
    direction = rot_vec_quat(
        c.light_dir[world % c.light_dir.shape[0], light], c.xquat[world % c.xpos.shape[0], body]
    )
    c.light_pos0[world % c.light_pos0.shape[0], light] = offset
    c.light_poscom0[world % c.light_poscom0.shape[0], light] = from_com
    c.light_dir0[world % c.light_dir0.shape[0], light] = wp.normalize(direction)


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def constants_at_qpos0(c: Constants, groups: int, lanes: int):
    """Recompute the constants of `groups` in the worlds of the mask; launch it over (worlds, lanes)."""
    world, lane = wp.tid()
    if not c.mask[world]:
        return
    for body in range(lane, c.nbody, lanes):
        _add_up_body(world, body, c)
    _wait_for_all()
    if groups & KIN0:
        for camera in range(lane, c.ncam, lanes):
            _camera_reference(world, camera, c)
        for light in range(lane, c.nlight, lanes):
            _light_reference(world, light, c)
    if groups & INERT0 == 0:
        return
    for dof in range(lane, c.nv, lanes):
        _mass_matrix_row(world, dof, c)
    _wait_for_all()
    _factorize(world, lane, lanes, c)
    for dof in range(lane, c.nv, lanes):
        _invert_row(world, dof, c)
    _wait_for_all()
    for dof in range(lane, c.nv, lanes):
        _dof_invweight(world, dof, c)
    for body in range(lane, c.nbody, lanes):
        _body_invweight(world, body, c)
    for actuator in range(lane, c.actuator_dof.shape[0], lanes):
        _actuator_acceleration(world, actuator, c)
