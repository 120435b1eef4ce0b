"""Warp kernels for work that a substep or reset of MuJoCo Warp leaves undone."""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

from collections.abc import Sequence

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import upstream

PLANE, CAPSULE, BOX = (int(mjw.GeomType[name]) for name in ("PLANE", "CAPSULE", "BOX"))
HAS_ROWS = int(upstream.ContactType.CONSTRAINT)
# Below this tilt, rad, the direction of a capsule is rounding of float32.
UPRIGHT = wp.constant(1.0e-6)
# No contact is so deep, m, that it has rows below this margin.
NO_ROWS = wp.constant(-1.0e10)
# Least time constant of a filter, s.
MINVAL = wp.constant(float(mujoco.mjMINVAL))


@wp.kernel(enable_backward=False)
def align_steep_capsules(
    geom_type: wp.array[int],
    geom_xmat: wp.array2d[wp.mat33],
    geom: wp.array[wp.vec2i],
    world: wp.array[int],
    nacon: wp.array[int],
    surfaces_move: bool,
    frame: wp.array[wp.mat33],
    surfacevel: wp.array[wp.vec3],
):
    """Let the first tangent of a contact of plane and capsule follow the capsule, however steep it stands.

    Of an upright one, which has no direction to follow, C takes the first axis of the world. The velocity of a surface
    is along the tangents, and is turned with them.
    """
    contact = wp.tid()
    # The launch has a thread for each place of the pool, of which the first `nacon` are in use.
    if contact >= nacon[0]:
        return
    # Geoms of a contact are -1 where flexes touch.
    plane = geom[contact][0]
    capsule = geom[contact][1]
    if plane < 0 or capsule < 0 or geom_type[plane] != PLANE or geom_type[capsule] != CAPSULE:
        return
    turn = geom_xmat[world[contact], capsule]
    normal = frame[contact][0]
    # The capsule's axis is the z axis of its frame.
    axis = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
    # Its projection on the plane, of a length from 0 (upright) to 1.
    tangent = axis - wp.dot(axis, normal) * normal
    # MuJoCo Warp does so itself from a length of 0.5 on.
    if wp.length(tangent) >= 0.5:
        return
    if wp.length(tangent) <= UPRIGHT:
        first = wp.vec3(1.0, 0.0, 0.0)
        tangent = first - wp.dot(first, normal) * normal
    # On a wall that faces that axis there is none left.
    if wp.length(tangent) <= UPRIGHT:
        return
    tangent = wp.normalize(tangent)
    # Normal, tangent and second tangent are right-handed.
    second = wp.cross(normal, tangent)
    if surfaces_move:
        # The same velocity in the old tangents, expressed in the new ones.
        along = surfacevel[contact]
        glide = along[0] * frame[contact][1] + along[1] * frame[contact][2]
        surfacevel[contact] = wp.vec3(wp.dot(glide, tangent), wp.dot(glide, second), along[2])
    frame[contact] = wp.matrix_from_rows(normal, tangent, second)


@wp.kernel(enable_backward=False)
def drop_upper_corners(
    geom_type: wp.array[int],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
    geom: wp.array[wp.vec2i],
    world: wp.array[int],
    dist: wp.array[float],
    nacon: wp.array[int],
    kind: wp.array[int],
):
    """Drop the contacts of a plane with those corners of a box that are above the box's centre."""
    contact = wp.tid()
    if contact >= nacon[0]:
        return
    plane = geom[contact][0]
    box = geom[contact][1]
    if plane < 0 or box < 0 or geom_type[plane] != PLANE or geom_type[box] != BOX:
        return
    # The plane's normal, world frame.
    owner = world[contact]
    turn = geom_xmat[owner, plane]
    normal = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
    # Corners farther up than the box's centre are above it.
    if dist[contact] > wp.dot(normal, geom_xpos[owner, box] - geom_xpos[owner, plane]):
        kind[contact] = kind[contact] & ~HAS_ROWS


@wp.kernel(enable_backward=False)
def take_the_law_of_priority(
    geom_priority: wp.array[int],
    geom_solref: wp.array2d[wp.vec2],
    pair_geom1: wp.array[int],
    pair_geom2: wp.array[int],
    geom: wp.array[wp.vec2i],
    world: wp.array[int],
    nacon: wp.array[int],
    solref: wp.array[wp.vec2],
):
    """Let the geom of higher priority alone say how stiff a contact is, also where that is given directly."""
    contact = wp.tid()
    if contact >= nacon[0]:
        return
    a = geom[contact][0]
    b = geom[contact][1]
    if a < 0 or b < 0 or geom_priority[a] == geom_priority[b]:
        return
    # A <pair> of its own has its own law, and heeds no priority.
    for pair in range(pair_geom1.shape[0]):
        first = pair_geom1[pair]
        second = pair_geom2[pair]
        if (first == a and second == b) or (first == b and second == a):
            return
    stronger = wp.where(geom_priority[a] > geom_priority[b], a, b)
    solref[contact] = geom_solref[world[contact] % geom_solref.shape[0], stronger]


@wp.kernel(enable_backward=False)
def leave_out_rows(
    rigid_body: wp.array[int],
    geom: wp.array[wp.vec2i],
    nacon: wp.array[int],
    includemargin: wp.array[float],
    adhesion: wp.array[float],
):
    """Let contacts within one rigid body be out of reach of constraint rows, as contacts in a gap are.

    Those that stick have rows in a gap, too.
    """
    contact = wp.tid()
    if contact >= nacon[0]:
        return
    a = geom[contact][0]
    b = geom[contact][1]
    if a >= 0 and b >= 0 and rigid_body[a] == rigid_body[b]:
        includemargin[contact] = NO_ROWS
        adhesion[contact] = 0.0


@wp.kernel(enable_backward=False)
def loosen_rowless(kind: wp.array[int], nacon: wp.array[int], adhesion: wp.array[float]):
    """Let contacts without rows not stick: only a sensor of distances needs them, or they are dropped."""
    contact = wp.tid()
    if contact < nacon[0] and (kind[contact] & HAS_ROWS) == 0:
        adhesion[contact] = 0.0


@wp.kernel(enable_backward=False)
def sparse_velocity(
    rownnz: wp.array2d[int],
    rowadr: wp.array2d[int],
    colind: wp.array2d[int],
    matrix: wp.array2d[float],
    qvel: wp.array2d[float],
    velocity: wp.array2d[float],
):
    """Multiply each world's sparse matrix by qvel; its pattern is the world's own, or shared by all."""
    world, row = wp.tid()
    # A pattern of one row is shared by all worlds.
    pattern = world % rownnz.shape[0]
    total = float(0.0)  # noqa: UP018 (Warp: a variable that changes in a loop)
    for i in range(rowadr[pattern, row], rowadr[pattern, row] + rownnz[pattern, row]):
        total += matrix[world, i] * qvel[world, colind[pattern, i]]
    velocity[world, row] = total


def multiply_by_qvel(
    pattern: Sequence[wp.array], matrix: wp.array, qvel: wp.array, velocity: wp.array
) -> None:
    """Launch the products of each world's sparse matrix and its qvel; see `sparse_velocity` for the pattern."""
    inputs = [*pattern, matrix, qvel]
    wp.launch(sparse_velocity, dim=velocity.shape, inputs=inputs, outputs=[velocity])


@wp.kernel(enable_backward=False)
def copy_columns(columns: wp.array[int], source: wp.array2d[float], target: wp.array2d[float]):
    """Copy some columns of each world's row."""
    world, place = wp.tid()
    column = columns[place]
    target[world, column] = source[world, column]


@wp.kernel(enable_backward=False)
def spread_columns(columns: wp.array[int], source: wp.array2d[float], target: wp.array2d[float]):
    """Copy each world's row into some columns of a longer one."""
    world, place = wp.tid()
    target[world, columns[place]] = source[world, place]


@wp.kernel(enable_backward=False)
def gather_controls(
    ctrladr: wp.array[int],
    ctrlnum: wp.array[int],
    ctrllimited: wp.array[bool],
    ctrlrange: wp.array2d[wp.vec2],
    ranges_are_off: bool,
    ctrl: wp.array2d[float],
    gathered: wp.array2d[float],
):
    """Write the first control of each actuator, within its range, or zero where it has none."""
    world, actuator = wp.tid()
    found = float(0.0)  # noqa: UP018 (Warp: a variable that changes)
    if ctrlnum[actuator] > 0:
        column = ctrladr[actuator]
        found = ctrl[world, column]
        if ctrllimited[column] and not ranges_are_off:
            limits = ctrlrange[world % ctrlrange.shape[0], column]
            found = wp.clamp(found, limits[0], limits[1])
    gathered[world, actuator] = found


@wp.kernel(enable_backward=False)
def shifted_time(
    before: wp.array[float], timestep: wp.array[float], fraction: float, time: wp.array[float]
):
    """Write each world's time, some timesteps later."""
    world = wp.tid()
    time[world] = before[world] + fraction * timestep[world % timestep.shape[0]]


@wp.kernel(enable_backward=False)
def rate_exact_filters(
    actuators: wp.array[int],
    actadr: wp.array[int],
    dynprm: wp.array2d[upstream.vec10],
    timestep: wp.array[float],
    act_dot: wp.array2d[float],
    fraction: float,
    act: wp.array2d[float],
):
    """Move exact filters by their rate over a fraction of the timestep.

    They were moved by that fraction of their exact path over all of it.
    """
    world, i = wp.tid()
    actuator = actuators[i]
    h = timestep[world % timestep.shape[0]]
    tau = wp.max(dynprm[world % dynprm.shape[0], actuator][0], MINVAL)
    exact = tau * (1.0 - wp.exp(-h / tau))
    column = actadr[actuator]
    act[world, column] = act[world, column] + fraction * act_dot[world, column] * (h - exact)
