"""Finds the legs, soles and limbs of an unknown robot, and fits them with lean hulls."""

from dataclasses import dataclass

import mujoco
import numpy as np

from ksim_rl.scene.robots.edit import CollisionGeom, GeomAttributes, capsule, sphere

SLAB = 0.01
"""m: a point so near to a foot's lowest point belongs to its sole."""
RIDGE = 2 * SLAB
"""m: a sole that is narrower has no room for two capsules."""
MOST_LEVELLING = 30
LEVELLING_STEP = 2
"""How far a foot may be tilted while its sole is looked for, and the step of the search, degrees."""
LIMB = 0.15
"""Share of the robot's height from which on a limb is worth a hull."""
NO_FREE_JOINT = (
    "the model has 0 free joints: expected one, of the robot's root body; where the file fixes a robot that walks "
    "to the world, add <freejoint/> to its root body"
)
REACHES_GROUND = 0.08
"""Share of the robot's height up to which an end of a chain counts as one at the ground."""
ALIKE = 0.05
"""Legs that are built alike differ by less than this share in mass and length."""
ROUND = 0.1
"""A wheel is round, and its axle in its middle, up to this share of its radius."""
_HULL: GeomAttributes = {"condim": 1, "priority": 1}


@dataclass(frozen=True, kw_only=True)
class Leg:
    """The joints (model ids) from the root down to the body `foot`, and the shape that it treads with.

    The shape is a ball (one centre), a capsule (its two ends), or two of them along the sole: m in the foot's frame.
    """

    foot: str
    joints: tuple[int, ...]
    centres_N3: np.ndarray
    radius: float

    def points(self, data: mujoco.MjData) -> np.ndarray:
        """Return the lowest points of ball or capsules, world frame, m, [N, 3]."""
        body = data.body(self.foot)
        # From the foot's frame into the world, then down by the radius.
        return body.xpos + self.centres_N3 @ body.xmat.reshape(3, 3).T - [0.0, 0.0, self.radius]

    def pitch_joints(self, data: mujoco.MjData) -> dict[int, float]:
        """Return the joints that turn about the y axis, from the hip down, with the sign of that turn."""
        # Joints within 45 degrees of y; the sign tells which way they turn.
        signs = {}
        for j in self.joints:
            along_y = data.xaxis[j, 1]
            if abs(along_y) > 0.7:
                signs[j] = float(np.sign(along_y))
        return signs

    @property
    def geoms(self) -> list[CollisionGeom]:
        """The parts that tread on the ground."""
        name = f"{self.foot}_sole"
        foot = self.foot
        if len(self.centres_N3) == 1:
            return [sphere(name, foot, self.radius, rounded(self.centres_N3), priority=1)]
        # Centres come in pairs, the ends of each capsule.
        edges = [self.centres_N3[first : first + 2] for first in range(0, len(self.centres_N3), 2)]
        return [
            capsule(f"{name}{n}", foot, self.radius, rounded(ends), priority=1)
            for n, ends in enumerate(edges, 1)
        ]


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """A robot's build: the root body, legs, hulls of root and limbs, and m from bottom to top."""

    root: str
    legs: tuple[Leg, ...]
    hulls: tuple[CollisionGeom, ...]
    height: float


def dissect(mj_model: mujoco.MjModel, qpos: np.ndarray) -> Anatomy:
    """Return the build of a robot that stands upright in `qpos`; its feet are the lowest of the ends of its chains.

    Ends of legs that are built like the feet's legs are feet too, wherever the pose has them. A ValueError says what
    is missing, or that a foot is a wheel.
    """
    root = _root_of(mj_model)
    # Bodies without joints are parts of the body that they are welded to.
    weld = mj_model.body_weldid
    moving = [
        b for b in range(root, mj_model.nbody) if weld[b] == b and mj_model.body_rootid[b] == root
    ]
    upright = posed(mj_model, qpos)
    # Points of collision geoms by moving body, world frame, in the given pose.
    parts = {b: list(_points(mj_model, upright, b).values()) for b in moving}
    points = {b: np.concatenate(of_body) for b, of_body in parts.items() if of_body}
    if not points:
        raise ValueError("the model has no geoms: its feet cannot be found")
    heights = np.concatenate(list(points.values()))[:, 2]
    height = float(np.ptp(heights))
    # Bodies with children are no ends of chains.
    inner = {int(weld[mj_model.body_parentid[b]]) for b in moving}
    ends = [b for b in points if b not in {root, *inner}]
    # Feet are at the ground in the given pose.
    reached = heights.min() + REACHES_GROUND * height
    lowest = [b for b in ends if points[b][:, 2].min() < reached]
    if not lowest:
        raise ValueError(
            "no chain of joints ends at the lowest point of the model: it has no feet to stand on"
        )
    # A leg that the pose lifts is recognized by its build.
    builds = {b: _build_of(mj_model, b, root) for b in ends}
    feet = []
    for end in ends:
        is_like_a_foot = any(_alike(builds[end], builds[foot]) for foot in lowest)
        if end in lowest or is_like_a_foot:
            feet.append(end)
    # An ankle may bear several toes, which are one foot then.
    feet = list(dict.fromkeys(_foot_of(mj_model, points, toes, root) for toes in feet))
    if len(feet) < 2:
        raise ValueError(
            f"only {mj_model.body(feet[0]).name!r} is at the ground: expected at least two feet, for a robot that walks"
        )
    # A wheel reaches the ground like a foot, but rolls.
    for foot in feet:
        if (axle := _axle(mj_model, foot)) is not None:
            raise ValueError(
                f"body {mj_model.body(foot).name!r} is a wheel, which turns about joint {axle!r}: velocity tasks are "
                "of robots that walk on feet"
            )
    # With straight legs the soles of two-legged robots are level; others keep the pose that was given.
    flat = posed(mj_model, _straight(mj_model, qpos))
    # Points of root and long limbs in the frames of their bodies, for hulls.
    limbs = {
        b: (of_body - upright.xpos[b]) @ upright.xmat[b].reshape(3, 3)
        for b, of_body in points.items()
        if b == root or b not in feet and np.ptp(of_body, axis=0).max() > LIMB * height
    }
    return Anatomy(
        root=mj_model.body(root).name,
        legs=tuple(
            _leg(mj_model, flat if len(feet) == 2 else upright, foot, root) for foot in feet
        ),
        hulls=tuple(_hull(mj_model.body(b).name, of_body) for b, of_body in limbs.items()),
        height=height,
    )


def _straight(mj_model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return the pose with all joints at their references, and the root as it is in `qpos`."""
    straight = mj_model.qpos0.copy()
    # The free joint has the lowest joint type, 0.
    first = int(mj_model.jnt_qposadr[mj_model.jnt_type.argmin()])
    straight[first : first + 7] = qpos[first : first + 7]
    return straight


def _root_of(mj_model: mujoco.MjModel) -> int:
    """Return the body with the only free joint."""
    free = np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    bodies = [mj_model.body(mj_model.jnt_bodyid[joint]).name for joint in free]
    if len(free) == 1:
        return int(mj_model.jnt_bodyid[free[0]])
    if not bodies:
        raise ValueError(NO_FREE_JOINT)
    # The robot has most of the joints; props have their free one alone.
    trees = mj_model.body_rootid[mj_model.jnt_bodyid]
    joints = {name: int((trees == mj_model.body(name).id).sum()) for name in bodies}
    robot = max(bodies, key=lambda name: joints[name])
    props = [name for name in bodies if name != robot]
    flags = " ".join(f"--drop {name}" for name in props)
    raise ValueError(
        f"the model has {len(bodies)} free joints, of the bodies {', '.join(bodies)}: expected one, of the "
        f"robot's root body; leave the others out by {flags} (in Python: analyse(..., drop={props!r}))"
    )


def _foot_of(mj_model: mujoco.MjModel, points: dict[int, np.ndarray], toes: int, root: int) -> int:
    """Return the body that bears an end of a leg: where the body above toes treads too, that is the foot."""
    above = int(mj_model.body_weldid[mj_model.body_parentid[toes]])
    # A leg that hangs on the root directly has no foot above its toes.
    if above in (0, root) or above not in points:
        return toes
    treads = points[above][:, 2].min() < points[toes][:, 2].min() + SLAB
    if treads:
        return above
    return toes


def _build_of(mj_model: mujoco.MjModel, end: int, root: int) -> np.ndarray:
    """Return numbers that tell kinds of chains apart, from the root to a body: joints, slides among them, m and kg."""
    joints = _joints_above(mj_model, end, root)
    body = end
    length = 0.0
    mass = 0.0
    while body != root:
        above = int(mj_model.body_parentid[body])
        mass += float(mj_model.body_mass[body])
        if above != root:  # where on the root a leg hangs says nothing of its build
            length += float(np.linalg.norm(mj_model.body_pos[body]))
        body = above
    slides = int((mj_model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE).sum())
    return np.array([len(joints), slides, length, mass])


def _alike(build: np.ndarray, other: np.ndarray) -> bool:
    # Counts must be equal; length and mass may differ a little.
    counts_agree = bool((build[:2] == other[:2]).all())
    return counts_agree and bool(np.allclose(build[2:], other[2:], rtol=ALIKE, atol=1e-6))


def _axle(mj_model: mujoco.MjModel, body: int) -> str | None:
    """Return the joint about which a body turns as a wheel, round about an axis without limits; None for a foot."""
    # The last joint of the body is the one that turns it.
    last = int(mj_model.body_jntadr[body]) + int(mj_model.body_jntnum[body]) - 1
    is_hinge = mj_model.jnt_type[last] == mujoco.mjtJoint.mjJNT_HINGE
    if not is_hinge or mj_model.jnt_limited[last]:
        return None
    # In the model's own pose, relative to a point of the axis.
    data = posed(mj_model, mj_model.qpos0)
    points = np.concatenate(list(_points(mj_model, data, body).values())) - data.xanchor[last]
    # Two axes across the joint's.
    across = np.linalg.svd(data.xaxis[last][None])[2][1:]
    # The outline across the axis, as a box: low, high.
    flat = points @ across.T
    low = flat.min(0)
    high = flat.max(0)
    radius = float((high - low).max() / 2)
    is_centred = bool((np.abs(high + low) / 2 < ROUND * radius).all())
    is_round = float((high - low).min() / 2) > (1.0 - ROUND) * radius
    if is_centred and is_round:
        return mj_model.joint(last).name
    return None


def _joints_above(mj_model: mujoco.MjModel, body: int, root: int) -> list[int]:
    """Return the joints from the root, without its own, down to a body."""
    joints: list[int] = []
    while body != root:
        first = int(mj_model.body_jntadr[body])
        count = int(mj_model.body_jntnum[body])
        # In front, since the walk goes upwards.
        joints[:0] = range(first, first + count)
        # Welded bodies are skipped: they have no joints.
        body = int(mj_model.body_weldid[mj_model.body_parentid[body]])
    return joints


def lowest_point(mj_model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Return the height of the lowest point of all bodies that move, m."""
    # Body 0 and all welded to the world do not move.
    bodies = [b for b in range(mj_model.nbody) if mj_model.body_weldid[b] == b and b > 0]
    lowest = []
    for b in bodies:
        for points in _points(mj_model, data, b).values():
            lowest.append(points[:, 2].min())
    return float(min(lowest, default=0.0))


def posed(mj_model: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    """Return the data of a pose at rest."""
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_forward(mj_model, data)
    return data


def rounded(points: np.ndarray) -> tuple[float, ...]:
    """Return all numbers to a tenth of a millimetre."""
    # Adding 0 turns -0 into 0.
    return tuple(round(float(value), 4) + 0.0 for value in np.ravel(points))


def _leg(mj_model: mujoco.MjModel, data: mujoco.MjData, foot: int, root: int) -> Leg:
    # In the pose of `data`: soles are looked for at the lowest points.
    of_geoms = _points(mj_model, data, foot)
    points = np.concatenate(list(of_geoms.values()))
    ground = float(points[:, 2].min())
    treading = [g for g, of_geom in of_geoms.items() if of_geom[:, 2].min() < ground + SLAB]
    lowest = min(of_geoms, key=lambda g: of_geoms[g][:, 2].min())
    kind = mj_model.geom_type[lowest]
    # The first size of spheres and capsules is their radius.
    radius = float(mj_model.geom_size[lowest, 0])
    # Small geoms are studs of a sole, not the foot itself.
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE and radius >= SLAB:
        centres = data.geom_xpos[lowest][None]
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE and radius >= SLAB and len(treading) == 1:
        centres = _treading_ends(mj_model, data, lowest)
    else:
        # Any other shape: level the foot, find its sole there, and turn the result back.
        level = _levelling(points)
        levelled = points @ level.T
        centres, radius = _sole(levelled[levelled[:, 2] < levelled[:, 2].min() + SLAB])
        centres = centres @ level
    # World to foot's frame; a matrix on the right applies its transpose.
    local = (centres - data.xpos[foot]) @ data.xmat[foot].reshape(3, 3)
    joints = tuple(_joints_above(mj_model, foot, root))
    return Leg(foot=mj_model.body(foot).name, joints=joints, centres_N3=local, radius=radius)


def _treading_ends(mj_model: mujoco.MjModel, data: mujoco.MjData, capsule_id: int) -> np.ndarray:
    """Return the centres of a capsule's two ends, or of the lower one where it does not lie: m, world frame, [N, 3]."""
    # A capsule's axis is z of its frame.
    half = data.geom_xmat[capsule_id].reshape(3, 3)[:, 2] * mj_model.geom_size[capsule_id, 1]
    middle = data.geom_xpos[capsule_id]
    ends = np.stack((middle - half, middle + half))
    # Flat up to a slab: both ends tread.
    if abs(half[2]) * 2 < SLAB:
        return ends
    return ends[[ends[:, 2].argmin()]]


def _levelling(points_N3: np.ndarray) -> np.ndarray:
    """Return the rotation, of 30 degrees at most, that puts a foot on its largest face; none where it stands on one.

    A foot whose ankle is not level in this pose shows its sole as an edge. The size of a face is measured by
    the box about the points within a slab of it.
    """
    best = np.eye(3)
    most = 0.0
    # Smallest tilts first, so that they win ties.
    tilts = sorted(range(-MOST_LEVELLING, MOST_LEVELLING + 1, LEVELLING_STEP), key=abs)
    if _has_face(points_N3):
        return best
    for pitch in tilts:
        for roll in tilts:
            turn = _about(1, np.radians(pitch)) @ _about(0, np.radians(roll))
            turned = points_N3 @ turn.T
            # Half a slab: a face that is tilted by less than a step still lies within it.
            sole = turned[turned[:, 2] < turned[:, 2].min() + SLAB / 2]
            area = float(np.prod(np.ptp(sole[:, :2], axis=0)))
            # By a tenth, since of two tilts that differ by less the smaller one is meant.
            if area > 1.1 * most:
                best = turn
                most = area
    return best


def _has_face(points_N3: np.ndarray) -> bool:
    sole = points_N3[points_N3[:, 2] < points_N3[:, 2].min() + SLAB]
    return float(np.ptp(sole[:, :2], axis=0).min()) >= RIDGE


def _about(axis: int, angle: float) -> np.ndarray:
    """Return the rotation matrix about a world axis."""
    quat = np.zeros(4)
    matrix = np.zeros(9)
    mujoco.mju_axisAngle2Quat(quat, np.eye(3)[axis], angle)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _sole(points_N3: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centres and radius, m, of the balls in place of a sole with these lowest points, world frame."""
    x0, y0, z = points_N3.min(0)
    x1, y1, _ = points_N3.max(0)
    length = x1 - x0
    width = y1 - y0
    middle_x = (x0 + x1) / 2
    middle_y = (y0 + y1) / 2
    # A point-like foot: a ball.
    if max(length, width) < 4 * SLAB:
        radius = max(SLAB, float(length + width) / 4)
        return np.array([[middle_x, middle_y, z + radius]]), radius
    if min(length, width) < RIDGE:
        # A ridge: one capsule along it, since the edges of such a sole lie on each other.
        radius = SLAB
        z = z + radius
        if length > width:
            return np.array([[x0 + radius, middle_y, z], [x1 - radius, middle_y, z]]), radius
        return np.array([[middle_x, y0 + radius, z], [middle_x, y1 - radius, z]]), radius
    # A broad sole: two capsules along x, one at each edge.
    radius = round(min(1.5 * SLAB, float(min(length, width)) / 4), 4)
    # Capsules reach beyond their centres by the radius, so that they cover the sole's box.
    x0 = x0 + radius
    x1 = x1 - radius
    y0 = y0 + radius
    y1 = y1 - radius
    z = z + radius
    return np.array([[x0, y0, z], [x1, y0, z], [x0, y1, z], [x1, y1, z]]), radius


def _hull(body: str, points_N3: np.ndarray) -> CollisionGeom:
    """Return the capsule along the longest edge of the box about the points; it slides without friction."""
    low = points_N3.min(0)
    high = points_N3.max(0)
    middle = (low + high) / 2
    edges = high - low
    # The longest edge.
    axis = int(edges.argmax())
    # Leaner than the box, so that neighbours do not touch all the time.
    radius = round(float(0.4 * (edges.sum() - edges[axis]) / 2), 3)
    # Too short for a capsule.
    if edges[axis] / 2 < 1.2 * radius:
        return sphere(f"{body}_hull", body, radius, rounded(middle), **_HULL)
    reach = np.eye(3)[axis] * (edges[axis] / 2 - radius)
    return capsule(
        f"{body}_hull", body, radius, rounded(np.stack((middle - reach, middle + reach))), **_HULL
    )


def _points(mj_model: mujoco.MjModel, data: mujoco.MjData, body: int) -> dict[int, np.ndarray]:
    """Return vertices of meshes, or corners of boxes about geoms, by geoms welded to a body (all, if none collides)."""
    geoms = np.flatnonzero(mj_model.body_weldid[mj_model.geom_bodyid] == body)
    # Geoms of explicit pairs collide whatever their bits are.
    paired = {*mj_model.pair_geom1.tolist(), *mj_model.pair_geom2.tolist()}
    collide = [
        g
        for g in geoms
        if mj_model.geom_contype[g] or mj_model.geom_conaffinity[g] or int(g) in paired
    ]
    found = {}
    for g in collide or geoms:
        # MuJoCo's boxes are centre and half edges in the geom's frame.
        centre, half = mj_model.geom_aabb[g].reshape(2, 3)
        local = centre + half * np.array(
            [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        )
        # Vertices are tighter than a box, and tell a sole's shape.
        if mj_model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            first, count = (
                table[mj_model.geom_dataid[g]]
                for table in (mj_model.mesh_vertadr, mj_model.mesh_vertnum)
            )
            local = mj_model.mesh_vert[first : first + count]
        found[int(g)] = data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T
    return found
