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
}
# Of what is deeper, in m, the direction in which it is least deep is often one of many.
DEEP = 0.02


def ceiling_of(first: int, second: int) -> float | None:
    """Return the ceiling of a pair of geom types; None where its contacts shall be as in C."""
    kinds = {int(first), int(second)}
    by_iteration = kinds - {int(kind) for kind in _BY_FORMULA}
    if not by_iteration:
        return None
    # Points of these on planes, and a ball on a cylinder, have formulas.
    if int(_GEOM.mjGEOM_PLANE) in kinds or kinds == {int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_CYLINDER)}:
        return None
    names = [_GEOM(kind).name.removeprefix("mjGEOM_").lower() for kind in by_iteration]
    return max(DEPTH_CEILINGS.get(name, 0.0) for name in names)


def depth_limit(
    mj_model: mujoco.MjModel, pair: tuple[int, int], wanted: float, actual: float
) -> float | None:
    """Return how much the distances of a pair of geoms may differ, in m; None where they are too deep to compare."""
    kinds = mj_model.geom_type[list(pair)]
    ceiling = ceiling_of(*kinds)
    assert ceiling is not None  # these pairs alone have depths to compare
    on_field = _GEOM.mjGEOM_HFIELD in kinds
    # A ball is as deep in a field of heights as its centre, by formula.
    is_ball_in_field = on_field and _GEOM.mjGEOM_SPHERE in kinds
    if min(wanted, actual) < -DEEP and not is_ball_in_field:
        return None
    # Of what is tilted above a field, C's distances are off by the margin.
    return ceiling + (float(mj_model.geom_margin[list(pair)].max()) if on_field else 0.0)


def depths(geoms: np.ndarray, dist: np.ndarray, geom_type: np.ndarray) -> dict[tuple[int, int], float]:
    """Return the distance of the deepest contact of each accepted pair of geoms, in m."""
    found: dict[tuple[int, int], float] = {}
    for pair, value in zip(geoms, dist, strict=True):
        first, second = sorted(int(geom) for geom in pair)
        if min(first, second) < 0 or ceiling_of(geom_type[first], geom_type[second]) is None:
            continue
        found[first, second] = min(float(value), found.get((first, second), np.inf))
    return found
