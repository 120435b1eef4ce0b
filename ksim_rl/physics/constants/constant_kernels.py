"""These Warp kernels recompute the constants that MuJoCo derives at `qpos0`, in the worlds of a mask only.

Constants that follow from the joint-space inertia are computed in C++, see `constants_of_inertia.cuh`.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false

import functools

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.device import headers
from ksim_rl.device.upstream import with_preamble
from ksim_rl.physics.structs import struct_with
from ksim_rl.physics.upstream import mul_quat, quat_to_mat, rot_vec_quat

FREE = wp.constant(int(mujoco.mjtJoint.mjJNT_FREE))
BALL = wp.constant(int(mujoco.mjtJoint.mjJNT_BALL))
MINVAL = wp.constant(float(mujoco.mjMINVAL))
KIN0 = wp.constant(int(mjw.SetConstGroup.KIN0))
INERT0 = wp.constant(int(mjw.SetConstGroup.INERT0))
# Below this speed of its centre of mass, in m/s, a body whose joint moves at unit speed is one that does not move.
STANDS = wp.constant(1.0e-6)
_HEADER = "ksim_rl/physics/constants/constants_of_inertia.cuh"


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
    """The arrays of a model that the kernels read and write, and their own memory; `axis` and `anchor` are per dof."""

    mask: wp.array[bool]
    sums_masses: bool
    num_actuators: int
    dof_rotates: wp.array[float]
    group_start: wp.array[int]
    group_size: wp.array[int]
    slides_alone: wp.array[bool]
    last_dof: wp.array[int]
    actuator_dof: wp.array[int]
    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]
    anchor: wp.array2d[wp.vec3]
    axis: wp.array2d[wp.vec3]
    xipos: wp.array2d[wp.vec3]
    inertia: wp.array2d[wp.mat33]
    scratch: wp.array2d[float]


@wp.kernel(enable_backward=False)
def frames(c: Constants):
    """Body frames, and each dof's axis and anchor, at `qpos0`: there, hinges and slides do not move anything."""
    world = wp.tid()
    if not c.mask[world]:
        return
    # The world body is the root frame.
    c.xpos[world, 0] = wp.vec3(0.0, 0.0, 0.0)
    c.xquat[world, 0] = wp.quat(1.0, 0.0, 0.0, 0.0)
    # Bodies are ordered so that parents come before their children.
    for body in range(1, c.nbody):
        parent = c.body_parentid[body]
        turn = c.xquat[world, parent]
        # Fields have one row that all worlds share, or one for each world: hence the modulo.
        pos = c.xpos[world, parent] + rot_vec_quat(
            c.body_pos[world % c.body_pos.shape[0], body], turn
        )
        quat = mul_quat(turn, c.body_quat[world % c.body_quat.shape[0], body])
        for joint in range(c.body_jntadr[body], c.body_jntadr[body] + c.body_jntnum[body]):
            kind = c.jnt_type[joint]
            dof = c.jnt_dofadr[joint]
            q = c.jnt_qposadr[joint]
            row = world % c.qpos0.shape[0]
            pivot = c.jnt_pos[world % c.jnt_pos.shape[0], joint]
            if kind == FREE:
                # A free joint's pose is in qpos0 itself, world frame, whatever the body's own frame is.
                pos = wp.vec3(c.qpos0[row, q], c.qpos0[row, q + 1], c.qpos0[row, q + 2])
                quat = wp.normalize(
                    wp.quat(
                        c.qpos0[row, q + 3],
                        c.qpos0[row, q + 4],
                        c.qpos0[row, q + 5],
                        c.qpos0[row, q + 6],
                    )
                )
                # Its translations are along the world's axes, its rotations about the body's.
                for i in range(3):
                    unit = wp.vec3(0.0, 0.0, 0.0)
                    unit[i] = 1.0
                    c.axis[world, dof + i] = unit
                    c.anchor[world, dof + i] = pos
                    c.axis[world, dof + 3 + i] = rot_vec_quat(unit, quat)
                    c.anchor[world, dof + 3 + i] = pos
            # A ball turns about its anchor, which stays in place.
            elif kind == BALL:
                place = pos + rot_vec_quat(pivot, quat)
                # `qpos0` may be turned, and need not be a unit quaternion.
                turned = wp.quat(
                    c.qpos0[row, q], c.qpos0[row, q + 1], c.qpos0[row, q + 2], c.qpos0[row, q + 3]
                )
                quat = mul_quat(quat, wp.normalize(turned))
                # The body's origin moves around the anchor.
                pos = place - rot_vec_quat(pivot, quat)
                for i in range(3):
                    unit = wp.vec3(0.0, 0.0, 0.0)
                    unit[i] = 1.0
                    c.axis[world, dof + i] = rot_vec_quat(unit, quat)
                    c.anchor[world, dof + i] = place
            # A hinge or slide at qpos0 does not move the body, whatever number qpos0 is.
            else:
                c.anchor[world, dof] = pos + rot_vec_quat(pivot, quat)
                c.axis[world, dof] = rot_vec_quat(
                    c.jnt_axis[world % c.jnt_axis.shape[0], joint], quat
                )
        c.xpos[world, body] = pos
        c.xquat[world, body] = wp.normalize(quat)


@wp.func
def _add_up_body(world: int, body: int, c: Constants):
    """Write the mass of a body's subtree, its own centre of mass, and its inertia about it, in the world frame."""
    mass = float(0.0)  # noqa: UP018 (Warp: a variable that changes in a loop)
    # Bodies of a subtree are numbered one after the other.
    for other in range(body, body + c.body_subtreenum[body]):
        mass += c.body_mass[world % c.body_mass.shape[0], other]
    if c.sums_masses:
        c.body_subtreemass[world, body] = mass
    # Frames are shared by all worlds unless a field that moves them differs.
    frame = world % c.xpos.shape[0]
    turn = c.xquat[frame, body]
    c.xipos[world, body] = c.xpos[frame, body] + rot_vec_quat(
        c.body_ipos[world % c.body_ipos.shape[0], body], turn
    )
    # Principal moments, turned into the world frame.
    axes = quat_to_mat(mul_quat(turn, c.body_iquat[world % c.body_iquat.shape[0], body]))
    moments = c.body_inertia[world % c.body_inertia.shape[0], body]
    c.inertia[world, body] = axes @ wp.diag(moments) @ wp.transpose(axes)


@wp.func_native("constants_of_inertia::wait();")
def _wait_for_all() -> None:
    """Wait until all lanes of a world have written: a barrier of the block."""


@wp.func
def _subtree_com(world: int, body: int, c: Constants) -> wp.vec3:
    moment = wp.vec3(0.0, 0.0, 0.0)
    total = float(0.0)  # noqa: UP018
    for other in range(body, body + c.body_subtreenum[body]):
        mass = c.body_mass[world % c.body_mass.shape[0], other]
        moment += mass * c.xipos[world, other]
        total += mass
    # A massless subtree has no centre of mass: as in C, the body's own stands for it.
    if total < MINVAL:
        return c.xipos[world, body]
    return moment / total


@wp.func
def _references(world: int, body: int, target: int, pos: wp.vec3, c: Constants):
    """Return a place on a body from that body and from the centre of mass that it tracks, world axes, m."""
    frame = world % c.xpos.shape[0]
    # A negative target means that the camera tracks its own body.
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


@wp.kernel(enable_backward=False)
def mend_weights(c: Constants):
    """Give bodies the weights that C does where mujoco_warp.set_const gives others, by the frames at `qpos0`."""
    world, body = wp.tid()
    row = world % c.body_invweight0.shape[0]
    # A body on slides alone moves as a point mass, free of rotation.
    if c.slides_alone[body]:
        weight = 1.0 / c.body_mass[world % c.body_mass.shape[0], body]
        c.body_invweight0[row, body] = wp.vec2(weight, 0.0)
        last = c.last_dof[body]
        # All degrees of freedom of the body itself get that weight, too.
        while last >= 0 and c.dof_bodyid[last] == body:
            c.dof_invweight0[world % c.dof_invweight0.shape[0], last] = weight
            last = c.dof_parentid[last]
        return
    frame = world % c.xpos.shape[0]
    # The centre of mass at qpos0, world frame, m.
    com = c.xpos[frame, body] + rot_vec_quat(
        c.body_ipos[world % c.body_ipos.shape[0], body], c.xquat[frame, body]
    )
    fastest = float(0.0)  # noqa: UP018 (Warp: variables that change in a loop)
    turns = float(0.0)  # noqa: UP018
    dof = c.last_dof[body]
    # From the body's last degree of freedom up to the root.
    while dof >= 0:
        turns = wp.max(turns, c.dof_rotates[dof])
        velocity = c.axis[frame, dof]
        # A rotation moves the centre of mass by its lever; a slide by its axis.
        if c.dof_rotates[dof] > 0.0:
            velocity = wp.cross(velocity, com - c.anchor[frame, dof])
        fastest = wp.max(fastest, wp.length(velocity))
        dof = c.dof_parentid[dof]
    weights = c.body_invweight0[row, body]
    # Where one of two figures is zero, it takes the other one; C leaves it zero.
    if weights[0] == weights[1]:
        if turns == 0.0:
            c.body_invweight0[row, body] = wp.vec2(weights[0], 0.0)
        elif fastest < STANDS:
            c.body_invweight0[row, body] = wp.vec2(0.0, weights[1])


def floats_per_world(nv: int, nbody: int) -> int:
    """Return the floats that the C++ works on, in the order in which it lays them out."""
    # The factor of the inertia matrix and its inverse, then 9 floats per dof and 27 per body.
    return 2 * nv**2 + 9 * nv + 27 * nbody


@functools.cache
def constants_kernel(nv: int, nbody: int, lanes: int, in_shared: bool) -> wp.Kernel:
    """Return the kernel that recomputes constants; launch it over (worlds, lanes), in blocks of as many lanes.

    Its arrays are in shared memory, or else in the scratch memory of its `Constants`.
    """
    # Sizes are compile-time constants, so that arrays in shared memory have them; the cache keeps one kernel for each.
    sizes = {
        "NV": nv,
        "NB": nbody,
        "FLOATS": floats_per_world(nv, nbody),
        "IN_SHARED": int(in_shared),
        "LANES": lanes,
        "THREADS": lanes,
    }
    text = headers.text_of(_HEADER, sizes)
    values = [f"c.{name}" for name in headers.arguments_of(text)]

    @wp.func_native(headers.call_of(_HEADER, ("world", "lane"), values))
    def constants_of_inertia(world: int, lane: int, c: Constants) -> None: ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options={"block_dim": lanes, "extra_build_options": with_preamble(text)},
    )
    def constants_at_qpos0(c: Constants, groups: int):
        world, lane = wp.tid()
        if not c.mask[world]:
            return
        # Each lane takes every `lanes`-th body.
        for body in range(lane, c.nbody, lanes):
            _add_up_body(world, body, c)
        # The C++ below reads subtree masses and inertias of other lanes.
        _wait_for_all()
        if groups & INERT0:
            constants_of_inertia(world, lane, c)
        if groups & KIN0:
            # The last lanes have had the least to do.
            for camera in range(lanes - 1 - lane, c.ncam, lanes):
                _camera_reference(world, camera, c)
            for light in range(lanes - 1 - lane, c.nlight, lanes):
                _light_reference(world, light, c)

    return constants_at_qpos0
