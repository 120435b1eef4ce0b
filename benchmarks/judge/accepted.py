"""The one table of what may differ from MuJoCo's C engine: contacts that both engines find by iterations.

Their depths and numbers differ, and all forces with them. A state in which such a pair is within its margin is judged
by the depth of its contacts alone.
"""

import mujoco
import numpy as np

_GEOM = mujoco.mjtGeom
_BY_FORMULA = (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_BOX)
# Most that the deepest contact of a pair may differ in depth, in m. Pairs that are not here shall be as in C.
DEPTH_CEILINGS = {
    "ellipsoid": 2e-3,
    "cylinder": 2e-3,
    "mesh": 2e-3,
    "hfield": 2e-3,
    "element": 2e-3,
}
# In deeper contacts, m, the direction of least depth is often one of many.
DEEP = 0.02


# Stands among the types of geoms for an element of a flex.
ELEMENT = -1


def parts_of(
    mj_model: mujoco.MjModel, geoms: np.ndarray, flexes: np.ndarray, elements: np.ndarray
) -> np.ndarray:
    """Return the two parts that touch in each contact, int [N, 2]: geoms by number, and elements of flexes after them.

    Vertices of flexes are -1. All arrays are [N, 2], with -1 for what does not touch.
    """
    if mj_model.nflex == 0:
        return geoms
    first = mj_model.ngeom + mj_model.flex_elemadr[flexes]
    return np.where(elements >= 0, first + elements, geoms)


def kinds_of(mj_model: mujoco.MjModel, pair: tuple[int, int]) -> tuple[int, int]:
    """Return the types of two parts."""
    first, second = (
        int(mj_model.geom_type[part]) if part < mj_model.ngeom else ELEMENT for part in pair
    )
    return first, second


def name_of(kind: int) -> str:
    """Return the name of a type of geoms, or of elements."""
    return "element" if kind == ELEMENT else _GEOM(kind).name.removeprefix("mjGEOM_").lower()


def ceiling_of(first: int, second: int) -> float | None:
    """Return the ceiling of the types of two parts; None where their contacts shall be as in C."""
    kinds = {int(first), int(second)}
    if ELEMENT in kinds:
        # Triangles of cloths, and tetrahedra, that touch each other; what touches a geom shall be as in C.
        return DEPTH_CEILINGS["element"] if kinds == {ELEMENT} else None
    by_iteration = kinds - {int(kind) for kind in _BY_FORMULA}
    if not by_iteration:
        return None
    # Points of these on planes, and a ball on a cylinder, have formulas.
    if int(_GEOM.mjGEOM_PLANE) in kinds or kinds == {
        int(_GEOM.mjGEOM_SPHERE),
        int(_GEOM.mjGEOM_CYLINDER),
    }:
        return None
    return max(DEPTH_CEILINGS.get(name_of(kind), 0.0) for kind in by_iteration)


def depth_limit(
    mj_model: mujoco.MjModel, pair: tuple[int, int], wanted: float, actual: float
) -> float | None:
    """Return how much the distances of two parts may differ, in m; None where they are too deep to compare."""
    kinds = kinds_of(mj_model, pair)
    ceiling = ceiling_of(*kinds)
    assert ceiling is not None  # these pairs alone have depths to compare
    on_field = _GEOM.mjGEOM_HFIELD in kinds
    # A ball is as deep in a field of heights as its centre, by formula.
    is_ball_in_field = on_field and _GEOM.mjGEOM_SPHERE in kinds
    if min(wanted, actual) < -DEEP and not is_ball_in_field:
        return None
    # Of what is tilted above a field, C's distances are off by the margin.
    return ceiling + (float(mj_model.geom_margin[list(pair)].max()) if on_field else 0.0)


def depths(
    mj_model: mujoco.MjModel, parts: np.ndarray, dist: np.ndarray
) -> dict[tuple[int, int], float]:
    """Return the distance of the deepest contact of each accepted pair of parts, in m."""
    found: dict[tuple[int, int], float] = {}
    for pair, value in zip(parts, dist, strict=True):
        first, second = sorted(int(part) for part in pair)
        if min(first, second) < 0 or ceiling_of(*kinds_of(mj_model, (first, second))) is None:
            continue
        found[first, second] = min(float(value), found.get((first, second), np.inf))
    return found


def depths_in_c(mj_data: mujoco.MjData) -> dict[tuple[int, int], float]:
    """Return the same of the contacts that C has found."""
    contact = mj_data.contact
    pairs = (
        np.array(numbers).reshape(-1, 2) for numbers in (contact.geom, contact.flex, contact.elem)
    )
    return depths(mj_data.model, parts_of(mj_data.model, *pairs), np.array(contact.dist))
