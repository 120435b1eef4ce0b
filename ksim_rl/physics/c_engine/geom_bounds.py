"""The bounds of geoms that follow from sizes which differ between worlds; MuJoCo's compiler alone computes them."""

import mujoco
import numpy as np

_GEOMS = mujoco.mjtGeom
# A mesh or a height field has bounds of its own, and no size.
_SIZED = (
    _GEOMS.mjGEOM_SPHERE,
    _GEOMS.mjGEOM_CAPSULE,
    _GEOMS.mjGEOM_ELLIPSOID,
    _GEOMS.mjGEOM_CYLINDER,
    _GEOMS.mjGEOM_BOX,
)


def half_sizes(mj_model: mujoco.MjModel, size_EN3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the half sizes of the box around each geom, [E, N, 3] m, and which geoms have one, bool [N]."""
    kind = mj_model.geom_type
    # MuJoCo's sizes: a radius, then half a length, or three half sizes.
    radius = size_EN3[..., :1]
    length = size_EN3[..., 1:2]
    # Right for boxes and ellipsoids as it is.
    half = size_EN3.copy()
    sphere = kind == _GEOMS.mjGEOM_SPHERE
    half[:, sphere] = np.broadcast_to(radius, half.shape)[:, sphere]
    capsule = kind == _GEOMS.mjGEOM_CAPSULE
    half[:, capsule] = np.concatenate([radius, radius, radius + length], axis=-1)[:, capsule]
    cylinder = kind == _GEOMS.mjGEOM_CYLINDER
    half[:, cylinder] = np.concatenate([radius, radius, length], axis=-1)[:, cylinder]
    return half, np.isin(kind, _SIZED)


def radii(mj_model: mujoco.MjModel, size_EN3: np.ndarray) -> np.ndarray:
    """Return the radius of the sphere around each geom that has a size, [E, N] m."""
    kind = mj_model.geom_type
    first = size_EN3[..., 0]
    second = size_EN3[..., 1]
    found = np.linalg.norm(size_EN3, axis=-1)  # boxes
    found = np.where(kind == _GEOMS.mjGEOM_SPHERE, first, found)
    found = np.where(kind == _GEOMS.mjGEOM_CAPSULE, first + second, found)
    found = np.where(kind == _GEOMS.mjGEOM_CYLINDER, np.hypot(first, second), found)
    return np.where(kind == _GEOMS.mjGEOM_ELLIPSOID, size_EN3.max(axis=-1), found)
