"""A model is refused here if one of its sensors would read something else than in MuJoCo's C engine."""

import mujoco
import numpy as np

DISTANCES = (
    mujoco.mjtSensor.mjSENS_GEOMDIST,
    mujoco.mjtSensor.mjSENS_GEOMNORMAL,
    mujoco.mjtSensor.mjSENS_GEOMFROMTO,
)
SDF = mujoco.mjtGeom.mjGEOM_SDF
MESH = mujoco.mjtGeom.mjGEOM_MESH
SITE = mujoco.mjtObj.mjOBJ_SITE
_OTHER_SHAPES = "make the site a sphere, capsule, ellipsoid, cylinder or box"
GEOM = mujoco.mjtObj.mjOBJ_GEOM
BODY = mujoco.mjtObj.mjOBJ_BODY
TREE = mujoco.mjtObj.mjOBJ_XBODY


def check_sensors(mj_model: mujoco.MjModel) -> None:
    """Refuse sensors of distances or contacts that no kernel reads as MuJoCo's C engine does."""
    check_signed_distance_fields(mj_model)
    check_delayed(mj_model)
    check_sites_of_meshes(mj_model)
    flags = mj_model.opt.disableflags
    bits = mujoco.mjtDisableBit
    # Distances are measured in the collision pass.
    for sensor in np.flatnonzero(np.isin(mj_model.sensor_type, DISTANCES)):
        if flags & bits.mjDSBL_CONSTRAINT:
            raise ValueError(
                f"{_name(mj_model, int(sensor))} needs a collision pass, and <flag constraint='disable'/> leaves it "
                "out: disable contact, limit, equality and frictionloss instead"
            )
        if flags & bits.mjDSBL_CONTACT and mj_model.nflex:
            raise ValueError(
                f"{_name(mj_model, int(sensor))} needs a collision pass, in which flexes would touch in spite of "
                "<flag contact='disable'/>: set contype and conaffinity of the flexes to 0 instead"
            )


def check_delayed(mj_model: mujoco.MjModel) -> None:
    """Refuse the first contacts of several where they have no order, and bounds of touch that delay comes before."""
    for sensor in range(mj_model.nsensor):
        kind = mj_model.sensor_type[sensor]
        (samples, interpolation) = mj_model.sensor_history[sensor]
        # A `reduce` of 0 takes contacts as they come.
        takes_first = (
            kind == mujoco.mjtSensor.mjSENS_CONTACT and mj_model.sensor_intprm[sensor, 1] == 0
        )
        if takes_first and (samples or mj_model.nflex):
            raise ValueError(
                f"{_name(mj_model, sensor)} reads the first contacts, which have no order "
                f"{'where a sensor is delayed' if samples else 'in a model with flexes'}: set its reduce to mindist, "
                "maxforce or netforce"
            )
        # The samples of a delayed sensor are kept before our cutoff is applied.
        bounded = kind == mujoco.mjtSensor.mjSENS_TOUCH and mj_model.sensor_cutoff[sensor] > 0.0
        if bounded and samples and interpolation:
            raise ValueError(
                f"{_name(mj_model, sensor)} has a cutoff of {mj_model.sensor_cutoff[sensor]:g}, and its samples are "
                "interpolated before it is applied: set cutoff='0' or interp='zoh'"
            )


def check_sites_of_meshes(mj_model: mujoco.MjModel) -> None:
    """Refuse sensors of objects inside a mesh-shaped site: MuJoCo Warp does not compute the inside of a mesh."""
    kinds = mujoco.mjtSensor
    m = mj_model
    for sensor in np.flatnonzero(
        np.isin(m.sensor_type, (kinds.mjSENS_CONTACT, kinds.mjSENS_INSIDESITE))
    ):
        # A sensor that tells whether an object is inside names the site second.
        is_second = m.sensor_type[sensor] == kinds.mjSENS_INSIDESITE
        if is_second:
            kind = m.sensor_reftype[sensor]
        else:
            kind = m.sensor_objtype[sensor]
        site = int(m.sensor_refid[sensor] if is_second else m.sensor_objid[sensor])
        if kind == SITE and m.site_type[site] == MESH:
            raise ValueError(
                f"{_name(m, int(sensor))} reads what is in site {m.site(site).name!r}, which has the shape of a mesh, "
                f"and MuJoCo Warp knows no inside of it: {_OTHER_SHAPES}"
            )


def check_touched_sites(mj_model: mujoco.MjModel) -> None:
    """Refuse touch sensors of sites with the shape of a mesh: MuJoCo ends the program that reads them."""
    m = mj_model
    for sensor in np.flatnonzero(m.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH):
        site = int(m.sensor_objid[sensor])
        if m.site_type[site] == MESH:
            raise ValueError(
                f"{_name(m, int(sensor))} feels touches in site {m.site(site).name!r}, which has the shape of a mesh, "
                f"and MuJoCo cannot read it: {_OTHER_SHAPES}"
            )


def check_signed_distance_fields(mj_model: mujoco.MjModel) -> None:
    """Refuse signed distance fields of plugins that collide, and sensors of distances or contacts of any."""
    fields = np.flatnonzero(mj_model.geom_type == SDF)
    # Geoms of a <pair> collide whatever their contype is.
    collides = (mj_model.geom_contype | mj_model.geom_conaffinity) != 0
    collides[mj_model.pair_geom1] = True
    collides[mj_model.pair_geom2] = True
    for geom in fields:
        if mj_model.geom_plugin[geom] >= 0 and collides[geom]:
            raise ValueError(
                f"geom {mj_model.geom(int(geom)).name!r} collides, and its plugin computes it, which MuJoCo Warp does "
                "not call: give it a mesh instead, or contype='0' conaffinity='0'"
            )
    for sensor in np.flatnonzero(
        np.isin(mj_model.sensor_type, (*DISTANCES, mujoco.mjtSensor.mjSENS_CONTACT))
    ):
        of_contacts = mj_model.sensor_type[sensor] == mujoco.mjtSensor.mjSENS_CONTACT
        own = geoms_of(
            mj_model, mj_model.sensor_objtype[sensor], int(mj_model.sensor_objid[sensor])
        )
        others = geoms_of(
            mj_model, mj_model.sensor_reftype[sensor], int(mj_model.sensor_refid[sensor])
        )
        # A sensor that names one object reads its contacts with everything.
        found = fields[own[fields] | others[fields]]
        if of_contacts:
            found = found[collides[found]]
        if found.size:
            raise ValueError(
                f"{_name(mj_model, int(sensor))} reads {'contacts' if of_contacts else 'distances'} of geom "
                f"{mj_model.geom(int(found[0])).name!r}, a signed distance field, whose contacts MuJoCo Warp finds "
                "otherwise than the C engine: replace the geom by a mesh, or remove the sensor"
            )


def geoms_of(mj_model: mujoco.MjModel, kind: int, element: int) -> np.ndarray:
    """Return whether each geom is of an object of a sensor, bool [ngeom]; an object that is not named is all."""
    # An object may be a geom, a body, or a body with all below it.
    geoms = np.arange(mj_model.ngeom)
    if kind == GEOM:
        return geoms == element
    if kind == BODY:
        return mj_model.geom_bodyid == element
    if kind == TREE:
        below = [
            body == element or _is_below(mj_model, body, element) for body in range(mj_model.nbody)
        ]
        return np.array(below)[mj_model.geom_bodyid]
    return np.ones(mj_model.ngeom, dtype=bool)


def _is_below(mj_model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    # Children have higher numbers than their parents.
    while body > ancestor:
        body = int(mj_model.body_parentid[body])
    return body == ancestor


def _name(mj_model: mujoco.MjModel, sensor: int) -> str:
    name = mj_model.sensor(sensor).name
    if name:
        return f"sensor {name!r}"
    return f"sensor number {sensor} (unnamed)"
