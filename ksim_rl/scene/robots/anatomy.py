"""This module finds the legs, soles and limbs of a robot that it has never seen, and fits them with lean hulls."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from ksim_rl.scene.robots.edit import CollisionGeom, capsule, sphere

SLAB = 0.01
"""m: what is so near to a foot's lowest point belongs to its sole."""
LIMB = 0.15
"""Share of the robot's height from which on a limb is worth a hull."""
_HULL: dict[str, Any] = {"condim": 1, "priority": 1}


@dataclass(frozen=True, kw_only=True)
class Leg:
    """The joints (model ids) from the root down to the body `foot`, and what that treads with.

    That is a ball (one centre), or two capsules along the sole (their four ends): m in the foot's frame.
    """

    foot: str
    joints: tuple[int, ...]
    centres_N3: np.ndarray
    radius: float

    def points(self, data: mujoco.MjData) -> np.ndarray:
        """Return the lowest points of ball or capsules, world frame, m, [N, 3]."""
        body = data.body(self.foot)
        return body.xpos + self.centres_N3 @ body.xmat.reshape(3, 3).T - [0.0, 0.0, self.radius]

    def pitch_joints(self, data: mujoco.MjData) -> dict[int, float]:
        """Return the joints that turn about the y axis, from the hip down, with the sign of that turn."""
        return {j: float(np.sign(data.xaxis[j, 1])) for j in self.joints if abs(data.xaxis[j, 1]) > 0.7}

    @property
    def geoms(self) -> list[CollisionGeom]:
        """What treads on the ground."""
        name, foot = f"{self.foot}_sole", self.foot
        if len(self.centres_N3) == 1:
            return [sphere(name, foot, self.radius, rounded(self.centres_N3), priority=1)]
        edges = (self.centres_N3[:2], self.centres_N3[2:])
        return [
            capsule(f"{name}{n}", foot, self.radius, rounded(ends), priority=1)
            for n, ends in enumerate(edges, 1)
        ]


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """What is known of a robot's build: the root body, legs, hulls of root and limbs, and m from bottom to top."""

    root: str
    legs: tuple[Leg, ...]
    hulls: tuple[CollisionGeom, ...]
    height: float


def dissect(mj_model: mujoco.MjModel, qpos: np.ndarray) -> Anatomy:
    """Return the build of a robot that stands upright in `qpos`; its feet are the lowest of the ends of its chains."""
    free = np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(free) != 1:
        raise ValueError(
            f"the model has {len(free)} free joints: expected one, that of the robot's root body"
        )
    root = int(mj_model.jnt_bodyid[free[0]])
    # Bodies without joints are parts of the body that they are welded to.
    weld = mj_model.body_weldid
    moving = [b for b in range(root, mj_model.nbody) if weld[b] == b and mj_model.body_rootid[b] == root]
    for kind, names in (
        ("joint", {j: mj_model.joint(j).name for j in range(mj_model.njnt) if j != free[0]}),
        ("body", {b: mj_model.body(b).name for b in moving}),
    ):
        for number, name in names.items():
            if not name:
                raise ValueError(f"{kind} {number} of the model has no name: give it one")
    upright, flat = posed(mj_model, qpos), posed(mj_model, mj_model.qpos0)
    parts = {b: list(_points(mj_model, upright, b).values()) for b in moving}
    points = {b: np.concatenate(of_body) for b, of_body in parts.items() if of_body}
    if not points:
        raise ValueError("the model has no geoms: its feet cannot be found")
    heights = np.concatenate(list(points.values()))[:, 2]
    height, inner = float(np.ptp(heights)), {int(weld[mj_model.body_parentid[b]]) for b in moving}
    feet = [
        b
        for b, of_body in points.items()
        if b not in {root, *inner} and of_body[:, 2].min() < heights.min() + 0.08 * height
    ]
    if not feet:
        raise ValueError(
            "no chain of joints ends at the lowest point of the model: it has no feet to stand on"
        )
    limbs = {
        b: (of_body - upright.xpos[b]) @ upright.xmat[b].reshape(3, 3)
        for b, of_body in points.items()
        if b == root or b not in feet and np.ptp(of_body, axis=0).max() > LIMB * height
    }
    return Anatomy(
        root=mj_model.body(root).name,
        legs=tuple(_leg(mj_model, flat if len(feet) == 2 else upright, foot, root) for foot in feet),
        hulls=tuple(_hull(mj_model.body(b).name, of_body) for b, of_body in limbs.items()),
        height=height,
    )


def posed(mj_model: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    """Return the data of a pose at rest."""
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_forward(mj_model, data)
    return data


def rounded(points: np.ndarray) -> tuple[float, ...]:
    """Return all numbers to a tenth of a millimetre."""
    return tuple(round(float(value), 4) + 0.0 for value in np.ravel(points))


def _leg(mj_model: mujoco.MjModel, data: mujoco.MjData, foot: int, root: int) -> Leg:
    joints, body = [], foot
    while body != root:
        first = mj_model.body_jntadr[body]
        joints[:0] = range(first, first + mj_model.body_jntnum[body])
        body = int(mj_model.body_weldid[mj_model.body_parentid[body]])
    of_geoms = _points(mj_model, data, foot)
    lowest = min(of_geoms, key=lambda g: of_geoms[g][:, 2].min())
    points = np.concatenate(list(of_geoms.values()))
    sole = points[points[:, 2] < points[:, 2].min() + SLAB]
    (x0, y0, z), (x1, y1, _) = sole.min(0), sole.max(0)
    if mj_model.geom_type[lowest] == mujoco.mjtGeom.mjGEOM_SPHERE and mj_model.geom_size[lowest, 0] >= SLAB:
        radius, centres = float(mj_model.geom_size[lowest, 0]), data.geom_xpos[lowest][None]
    elif max(x1 - x0, y1 - y0) < 4 * SLAB:
        radius = max(SLAB, float(x1 - x0 + y1 - y0) / 4)
        centres = np.array([[(x0 + x1) / 2, (y0 + y1) / 2, z + radius]])
    else:
        radius = round(min(1.5 * SLAB, float(min(x1 - x0, y1 - y0)) / 4), 4)
        x0, x1, y0, y1, z = x0 + radius, x1 - radius, y0 + radius, y1 - radius, z + radius
        centres = np.array([[x0, y0, z], [x1, y0, z], [x0, y1, z], [x1, y1, z]])
    local = (centres - data.xpos[foot]) @ data.xmat[foot].reshape(3, 3)
    return Leg(foot=mj_model.body(foot).name, joints=tuple(joints), centres_N3=local, radius=radius)


def _hull(body: str, points_N3: np.ndarray) -> CollisionGeom:
    """Return the capsule along the longest edge of the box about the points; it slides without friction."""
    low, high = points_N3.min(0), points_N3.max(0)
    middle, edges = (low + high) / 2, high - low
    axis = int(edges.argmax())
    radius = round(float(0.4 * (edges.sum() - edges[axis]) / 2), 3)
    if edges[axis] / 2 < 1.2 * radius:
        return sphere(f"{body}_hull", body, radius, rounded(middle), **_HULL)
    reach = np.eye(3)[axis] * (edges[axis] / 2 - radius)
    return capsule(f"{body}_hull", body, radius, rounded(np.stack((middle - reach, middle + reach))), **_HULL)


def _points(mj_model: mujoco.MjModel, data: mujoco.MjData, body: int) -> dict[int, np.ndarray]:
    """Return vertices of meshes, or corners of boxes about geoms, by geoms welded to a body (all, if none collides)."""
    geoms = np.flatnonzero(mj_model.body_weldid[mj_model.geom_bodyid] == body)
    collide = [g for g in geoms if mj_model.geom_contype[g] or mj_model.geom_conaffinity[g]]
    found = {}
    for g in collide or geoms:
        centre, half = mj_model.geom_aabb[g].reshape(2, 3)
        local = centre + half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        if mj_model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            first, count = (
                table[mj_model.geom_dataid[g]] for table in (mj_model.mesh_vertadr, mj_model.mesh_vertnum)
            )
            local = mj_model.mesh_vert[first : first + count]
        found[int(g)] = data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T
    return found
