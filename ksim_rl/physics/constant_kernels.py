"""These Warp kernels recompute the constants that MuJoCo derives at `qpos0`, in the worlds of a mask only.

The joint-space inertia is factored as M = L^T D L over the tree of dofs (Featherstone, "Rigid Body Dynamics
Algorithms", 2008, section 6.5), and L is inverted row by row. Then J M^-1 J^T = sum_k (J L^-1)_k^2 / D_k for each
Jacobian row, with no further solve. One matrix [nv, nv] per world holds D on its diagonal, L below and L^-1 above
(transposed); entries of dofs that are not on one chain stay zero.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false

import mujoco
import warp as wp

FREE = wp.constant(int(mujoco.mjtJoint.mjJNT_FREE))
BALL = wp.constant(int(mujoco.mjtJoint.mjJNT_BALL))
MINVAL = wp.constant(float(mujoco.mjMINVAL))


@wp.func
def _multiply(a: wp.quat, b: wp.quat) -> wp.quat:
    # MuJoCo's order, (w, x, y, z).
    return wp.quat(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def _rotate(q: wp.quat, v: wp.vec3) -> wp.vec3:
    u = wp.vec3(q[1], q[2], q[3])
    t = 2.0 * wp.cross(u, v)
    return v + q[0] * t + wp.cross(u, t)


@wp.func
def _matrix(q: wp.quat) -> wp.mat33:
    return wp.matrix_from_cols(
        _rotate(q, wp.vec3(1.0, 0.0, 0.0)),
        _rotate(q, wp.vec3(0.0, 1.0, 0.0)),
        _rotate(q, wp.vec3(0.0, 0.0, 1.0)),
    )


@wp.func
def _point_velocity(rotates: float, axis: wp.vec3, anchor: wp.vec3, point: wp.vec3) -> wp.vec3:
    """Velocity of a point when its dof moves at unit speed."""
    return rotates * wp.cross(axis, point - anchor) + (1.0 - rotates) * axis


@wp.kernel(enable_backward=False)
def frames(
    mask: wp.array[bool],
    nbody: int,
    qpos0: wp.array2d[float],
    body_parentid: wp.array[int],
    body_jntnum: wp.array[int],
    body_jntadr: wp.array[int],
    body_pos: wp.array2d[wp.vec3],
    body_quat: wp.array2d[wp.quat],
    jnt_type: wp.array[int],
    jnt_qposadr: wp.array[int],
    jnt_dofadr: wp.array[int],
    jnt_pos: wp.array2d[wp.vec3],
    jnt_axis: wp.array2d[wp.vec3],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    anchor: wp.array2d[wp.vec3],
    axis: wp.array2d[wp.vec3],
):
    """Body frames, and each dof's axis and anchor, at `qpos0`: there, hinges and slides do not move anything."""
    world = wp.tid()
    if not mask[world]:
        return
    xpos[world, 0] = wp.vec3(0.0, 0.0, 0.0)
    xquat[world, 0] = wp.quat(1.0, 0.0, 0.0, 0.0)
    for body in range(1, nbody):
        parent = body_parentid[body]
        turn = xquat[world, parent]
        pos = xpos[world, parent] + _rotate(turn, body_pos[world % body_pos.shape[0], body])
        quat = _multiply(turn, body_quat[world % body_quat.shape[0], body])
        for joint in range(body_jntadr[body], body_jntadr[body] + body_jntnum[body]):
            kind = jnt_type[joint]
            dof = jnt_dofadr[joint]
            q = jnt_qposadr[joint]
            row = world % qpos0.shape[0]
            pivot = jnt_pos[world % jnt_pos.shape[0], joint]
            if kind == FREE:
                pos = wp.vec3(qpos0[row, q], qpos0[row, q + 1], qpos0[row, q + 2])
                quat = wp.normalize(
                    wp.quat(qpos0[row, q + 3], qpos0[row, q + 4], qpos0[row, q + 5], qpos0[row, q + 6])
                )
                for i in range(3):
                    unit = wp.vec3(0.0, 0.0, 0.0)
                    unit[i] = 1.0
                    axis[world, dof + i] = unit
                    anchor[world, dof + i] = pos
                    axis[world, dof + 3 + i] = _rotate(quat, unit)
                    anchor[world, dof + 3 + i] = pos
            elif kind == BALL:
                place = pos + _rotate(quat, pivot)
                turned = wp.quat(qpos0[row, q], qpos0[row, q + 1], qpos0[row, q + 2], qpos0[row, q + 3])
                quat = _multiply(quat, wp.normalize(turned))
                pos = place - _rotate(quat, pivot)
                for i in range(3):
                    unit = wp.vec3(0.0, 0.0, 0.0)
                    unit[i] = 1.0
                    axis[world, dof + i] = _rotate(quat, unit)
                    anchor[world, dof + i] = place
            else:
                anchor[world, dof] = pos + _rotate(quat, pivot)
                axis[world, dof] = _rotate(quat, jnt_axis[world % jnt_axis.shape[0], joint])
        xpos[world, body] = pos
        xquat[world, body] = wp.normalize(quat)


@wp.kernel(enable_backward=False)
def inertias(
    mask: wp.array[bool],
    body_inertia: wp.array2d[wp.vec3],
    body_ipos: wp.array2d[wp.vec3],
    body_iquat: wp.array2d[wp.quat],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    xipos: wp.array2d[wp.vec3],
    inertia: wp.array2d[wp.mat33],
):
    """Each body's centre of mass, and its inertia about that, in the world frame."""
    world, body = wp.tid()
    if not mask[world]:
        return
    frame = world % xpos.shape[0]
    turn = xquat[frame, body]
    xipos[world, body] = xpos[frame, body] + _rotate(turn, body_ipos[world % body_ipos.shape[0], body])
    axes = _matrix(_multiply(turn, body_iquat[world % body_iquat.shape[0], body]))
    moments = body_inertia[world % body_inertia.shape[0], body]
    inertia[world, body] = axes @ wp.diag(moments) @ wp.transpose(axes)


@wp.kernel(enable_backward=False)
def mass_matrix(
    mask: wp.array[bool],
    num_actuators: int,
    dof_bodyid: wp.array[int],
    dof_parentid: wp.array[int],
    dof_rotates: wp.array[float],
    body_subtreenum: wp.array[int],
    body_mass: wp.array2d[float],
    dof_armature: wp.array2d[float],
    actuator_dof: wp.array[int],
    actuator_armature: wp.array2d[float],
    actuator_gear: wp.array2d[wp.spatial_vector],
    anchor: wp.array2d[wp.vec3],
    axis: wp.array2d[wp.vec3],
    xipos: wp.array2d[wp.vec3],
    inertia: wp.array2d[wp.mat33],
    factor: wp.array3d[float],
):
    """Row `dof` of M: what the momentum of its subtree, moved at unit speed, is along the dofs of its chain."""
    world, dof = wp.tid()
    if not mask[world]:
        return
    frame = world % axis.shape[0]
    first = dof_bodyid[dof]
    point = xipos[world, first]
    rotates = dof_rotates[dof]
    turning = rotates * axis[frame, dof]
    momentum = wp.vec3(0.0, 0.0, 0.0)
    spin = wp.vec3(0.0, 0.0, 0.0)
    for body in range(first, first + body_subtreenum[first]):
        com = xipos[world, body]
        velocity = _point_velocity(rotates, axis[frame, dof], anchor[frame, dof], com)
        part = body_mass[world % body_mass.shape[0], body] * velocity
        momentum += part
        spin += inertia[world, body] @ turning + wp.cross(com - point, part)
    armature = float(dof_armature[world % dof_armature.shape[0], dof])
    for i in range(num_actuators):
        if actuator_dof[i] == dof:
            gear = actuator_gear[world % actuator_gear.shape[0], i][0]
            armature += actuator_armature[world % actuator_armature.shape[0], i] * gear * gear
    other = dof
    while other >= 0:
        along = dof_rotates[other]
        velocity = _point_velocity(along, axis[frame, other], anchor[frame, other], point)
        factor[world, dof, other] = (
            wp.dot(momentum, velocity) + along * wp.dot(spin, axis[frame, other]) + armature
        )
        armature = 0.0
        other = dof_parentid[other]


@wp.kernel(enable_backward=False)
def factorize(mask: wp.array[bool], nv: int, dof_parentid: wp.array[int], factor: wp.array3d[float]):
    """M = L^T D L, in place, from the leaves to the root."""
    world = wp.tid()
    if not mask[world]:
        return
    for step in range(nv):
        k = nv - 1 - step
        inverse = 1.0 / factor[world, k, k]
        i = dof_parentid[k]
        while i >= 0:
            ratio = factor[world, k, i] * inverse
            j = i
            while j >= 0:
                factor[world, i, j] = factor[world, i, j] - ratio * factor[world, k, j]
                j = dof_parentid[j]
            factor[world, k, i] = ratio
            i = dof_parentid[i]


@wp.kernel(enable_backward=False)
def invert(mask: wp.array[bool], dof_parentid: wp.array[int], factor: wp.array3d[float]):
    """Row `dof` of X = L^-1, from X L = 1; X[dof, k] is kept at [k, dof]."""
    world, dof = wp.tid()
    if not mask[world]:
        return
    k = dof_parentid[dof]
    while k >= 0:
        total = float(factor[world, dof, k])
        j = dof_parentid[dof]
        while j > k:
            total += factor[world, j, dof] * factor[world, j, k]
            j = dof_parentid[j]
        factor[world, k, dof] = -total
        k = dof_parentid[k]


@wp.kernel(enable_backward=False)
def dof_invweights(
    mask: wp.array[bool],
    dof_parentid: wp.array[int],
    group_start: wp.array[int],
    group_size: wp.array[int],
    factor: wp.array3d[float],
    dof_invweight0: wp.array2d[float],
):
    """Diagonal of M^-1, averaged over the translations and over the rotations of one joint."""
    world, dof = wp.tid()
    if not mask[world]:
        return
    total = float(0.0)  # noqa: UP018 (Warp: a variable that changes in a loop)
    for member in range(group_start[dof], group_start[dof] + group_size[dof]):
        total += 1.0 / factor[world, member, member]
        k = dof_parentid[member]
        while k >= 0:
            total += factor[world, k, member] * factor[world, k, member] / factor[world, k, k]
            k = dof_parentid[k]
    dof_invweight0[world % dof_invweight0.shape[0], dof] = total / float(group_size[dof])


@wp.kernel(enable_backward=False)
def body_invweights(
    mask: wp.array[bool],
    dof_parentid: wp.array[int],
    dof_rotates: wp.array[float],
    last_dof: wp.array[int],
    anchor: wp.array2d[wp.vec3],
    axis: wp.array2d[wp.vec3],
    xipos: wp.array2d[wp.vec3],
    factor: wp.array3d[float],
    body_invweight0: wp.array2d[wp.vec2],
):
    """Mean diagonal of J M^-1 J^T at each centre of mass: translation, rotation."""
    world, body = wp.tid()
    if not mask[world]:
        return
    frame = world % axis.shape[0]
    point = xipos[world, body]
    moved = float(0.0)  # noqa: UP018
    turned = float(0.0)  # noqa: UP018
    k = last_dof[body]
    while k >= 0:
        linear = wp.vec3(0.0, 0.0, 0.0)
        angular = wp.vec3(0.0, 0.0, 0.0)
        i = last_dof[body]
        while i >= k:
            share = float(1.0)  # noqa: UP018
            if i > k:
                share = factor[world, k, i]
            linear += share * _point_velocity(dof_rotates[i], axis[frame, i], anchor[frame, i], point)
            angular += share * dof_rotates[i] * axis[frame, i]
            i = dof_parentid[i]
        moved += wp.dot(linear, linear) / factor[world, k, k]
        turned += wp.dot(angular, angular) / factor[world, k, k]
        k = dof_parentid[k]
    translation = moved / 3.0
    rotation = turned / 3.0
    # A body that can only slide, or only turn, takes the other figure, as in mujoco_warp.set_const.
    if translation < MINVAL:
        translation = rotation
    elif rotation < MINVAL:
        rotation = translation
    body_invweight0[world % body_invweight0.shape[0], body] = wp.vec2(translation, rotation)


@wp.kernel(enable_backward=False)
def actuator_accelerations(
    mask: wp.array[bool],
    nv: int,
    dof_parentid: wp.array[int],
    actuator_dof: wp.array[int],
    actuator_gear: wp.array2d[wp.spatial_vector],
    factor: wp.array3d[float],
    actuator_acc0: wp.array2d[float],
):
    """Norm of the acceleration from unit force: of column `actuator_dof` of M^-1, times the gear."""
    world, actuator = wp.tid()
    if not mask[world]:
        return
    dof = actuator_dof[actuator]
    total = float(0.0)  # noqa: UP018
    for other in range(nv):
        entry = float(0.0)  # noqa: UP018
        k = dof
        while k >= 0:
            left = float(1.0)  # noqa: UP018
            right = float(0.0)  # noqa: UP018
            if k < dof:
                left = factor[world, k, dof]
            if k == other:
                right = 1.0
            elif k < other:
                right = factor[world, k, other]
            entry += left * right / factor[world, k, k]
            k = dof_parentid[k]
        total += entry * entry
    gear = actuator_gear[world % actuator_gear.shape[0], actuator][0]
    actuator_acc0[world % actuator_acc0.shape[0], actuator] = wp.abs(gear) * wp.sqrt(total)


@wp.func
def _subtree_com(
    world: int,
    body: int,
    body_subtreenum: wp.array[int],
    body_mass: wp.array2d[float],
    xipos: wp.array2d[wp.vec3],
) -> wp.vec3:
    moment = wp.vec3(0.0, 0.0, 0.0)
    total = float(0.0)  # noqa: UP018
    for other in range(body, body + body_subtreenum[body]):
        mass = body_mass[world % body_mass.shape[0], other]
        moment += mass * xipos[world, other]
        total += mass
    if total < MINVAL:
        return xipos[world, body]
    return moment / total


@wp.kernel(enable_backward=False)
def camera_references(
    mask: wp.array[bool],
    cam_bodyid: wp.array[int],
    cam_targetbodyid: wp.array[int],
    cam_pos: wp.array2d[wp.vec3],
    cam_quat: wp.array2d[wp.quat],
    body_subtreenum: wp.array[int],
    body_mass: wp.array2d[float],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    xipos: wp.array2d[wp.vec3],
    cam_pos0: wp.array2d[wp.vec3],
    cam_poscom0: wp.array2d[wp.vec3],
    cam_mat0: wp.array2d[wp.mat33],
):
    """Where cameras are at `qpos0`: from their body, and from the centre of mass that they track."""
    world, camera = wp.tid()
    if not mask[world]:
        return
    frame = world % xpos.shape[0]
    body = cam_bodyid[camera]
    tracked = cam_targetbodyid[camera]
    if tracked < 0:
        tracked = body
    turn = xquat[frame, body]
    offset = _rotate(turn, cam_pos[world % cam_pos.shape[0], camera])
    com = _subtree_com(world, tracked, body_subtreenum, body_mass, xipos)
    cam_pos0[world % cam_pos0.shape[0], camera] = offset
    cam_poscom0[world % cam_poscom0.shape[0], camera] = xpos[frame, body] + offset - com
    cam_mat0[world % cam_mat0.shape[0], camera] = _matrix(
        _multiply(turn, cam_quat[world % cam_quat.shape[0], camera])
    )


@wp.kernel(enable_backward=False)
def light_references(
    mask: wp.array[bool],
    light_bodyid: wp.array[int],
    light_targetbodyid: wp.array[int],
    light_pos: wp.array2d[wp.vec3],
    light_dir: wp.array2d[wp.vec3],
    body_subtreenum: wp.array[int],
    body_mass: wp.array2d[float],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    xipos: wp.array2d[wp.vec3],
    light_pos0: wp.array2d[wp.vec3],
    light_poscom0: wp.array2d[wp.vec3],
    light_dir0: wp.array2d[wp.vec3],
):
    """Where lights are at `qpos0`: from their body, and from the centre of mass that they track."""
    world, light = wp.tid()
    if not mask[world]:
        return
    frame = world % xpos.shape[0]
    body = light_bodyid[light]
    tracked = light_targetbodyid[light]
    if tracked < 0:
        tracked = body
    turn = xquat[frame, body]
    offset = _rotate(turn, light_pos[world % light_pos.shape[0], light])
    com = _subtree_com(world, tracked, body_subtreenum, body_mass, xipos)
    light_pos0[world % light_pos0.shape[0], light] = offset
    light_poscom0[world % light_poscom0.shape[0], light] = xpos[frame, body] + offset - com
    direction = _rotate(turn, light_dir[world % light_dir.shape[0], light])
    light_dir0[world % light_dir0.shape[0], light] = wp.normalize(direction)
