"""Random sensors of all kinds."""

import xml.etree.ElementTree as ET

from benchmarks.judge.draw import Draw
from benchmarks.judge.scene import Scene

OF_SITES = (
    "touch",
    "accelerometer",
    "velocimeter",
    "gyro",
    "force",
    "torque",
    "magnetometer",
    "rangefinder",
    "camprojection",
    "insidesite",
)
OF_JOINTS = (
    "jointpos",
    "jointvel",
    "jointactuatorfrc",
    "ballquat",
    "ballangvel",
    "jointlimitpos",
    "jointlimitvel",
    "jointlimitfrc",
)
OF_TENDONS = (
    "tendonpos",
    "tendonvel",
    "tendonactuatorfrc",
    "tendonlimitpos",
    "tendonlimitvel",
    "tendonlimitfrc",
)
OF_ACTUATORS = ("actuatorpos", "actuatorvel", "actuatorfrc")
OF_FRAMES = (
    "framepos",
    "framequat",
    "framexaxis",
    "frameyaxis",
    "framezaxis",
    "framelinvel",
    "frameangvel",
    "framelinacc",
    "frameangacc",
)
OF_BODIES = ("subtreecom", "subtreelinvel", "subtreeangmom")
OF_GEOMS = ("distance", "normal", "fromto", "contact")
OF_WORLD = ("e_potential", "e_kinetic", "clock")
SENSORS = (
    *OF_SITES,
    *OF_JOINTS,
    *OF_TENDONS,
    *OF_ACTUATORS,
    *OF_FRAMES,
    *OF_BODIES,
    *OF_GEOMS,
    *OF_WORLD,
)
# Directions and orientations have no bounds, and of distances the cutoff is how far they reach.
WITHOUT_CUTOFF = (
    "distance",
    "normal",
    "fromto",
    "contact",
    "ballquat",
    "insidesite",
    *OF_FRAMES[1:5],
)
REDUCES = ("none", "mindist", "maxforce", "netforce")
DATA = ("found force", "found dist pos normal", "force torque tangent", "found")


def add_sensors(scene: Scene, draw: Draw) -> None:
    """Add some sensors, and those that are wanted."""
    kinds = draw.kinds("sensor", SENSORS, int(draw.rng.integers(3, 10)))
    for kind in dict.fromkeys(kinds):
        sensor = _sensor(scene, draw, kind)
        if sensor is None:
            draw.taken.discard(f"sensor.{kind}")
            continue
        sensor.set("name", f"sensor{len(scene.sensor) - 1}")
        if kind not in WITHOUT_CUTOFF and draw.takes("sensor_cutoff", 0.1):
            sensor.set("cutoff", "0.3")
        if kind not in ("contact", "touch") and draw.takes("sensor_delay", 0.05):
            sensor.set("delay", "0.008")
            sensor.set("nsample", "4")


def _sensor(scene: Scene, draw: Draw, kind: str) -> ET.Element | None:
    """Add a sensor of some kind; None where the model has nothing that it reads."""
    section = scene.sensor
    if kind in OF_WORLD:
        return ET.SubElement(section, kind)
    if kind in OF_BODIES:
        return ET.SubElement(section, kind, body=draw.any(scene.bodies))
    if kind in OF_FRAMES:
        return _of_frame(scene, draw, kind)
    if kind in OF_GEOMS:
        return _of_geoms(scene, draw, kind)
    if kind in OF_SITES:
        return _of_site(scene, draw, kind)
    limits = "limit" in kind
    if kind in OF_JOINTS:
        balls, scalars = scene.joints.get("ball", []), scene.scalars()
        names = balls if kind.startswith("ball") else scene.limited_joints if limits else scalars
        return ET.SubElement(section, kind, joint=draw.any(names)) if names else None
    if kind in OF_TENDONS:
        names = scene.limited_tendons if limits else scene.fixed_tendons + scene.spatial_tendons
        return ET.SubElement(section, kind, tendon=draw.any(names)) if names else None
    return (
        ET.SubElement(section, kind, actuator=draw.any(scene.actuators))
        if scene.actuators
        else None
    )


def _of_frame(scene: Scene, draw: Draw, kind: str) -> ET.Element:
    objects = {
        "body": scene.bodies,
        "xbody": scene.bodies,
        "geom": scene.all_geoms(),
        "site": scene.sites,
    }
    if scene.cameras:
        objects["camera"] = scene.cameras
    type_of_object = draw.any(list(objects))
    sensor = ET.SubElement(
        scene.sensor, kind, objtype=type_of_object, objname=draw.any(objects[type_of_object])
    )
    # Accelerations are measured in the world's frame alone.
    if not kind.endswith("acc") and draw.takes("sensor_reference", 0.3):
        sensor.set("reftype", "site")
        sensor.set("refname", draw.any(scene.sites))
    return sensor


def _of_geoms(scene: Scene, draw: Draw, kind: str) -> ET.Element | None:
    if kind == "contact":
        return _of_contacts(scene, draw)
    # Distances that iterations find are another matter.
    names = [name for kind in ("sphere", "capsule", "box") for name in scene.geoms.get(kind, [])]
    if len(names) < 2:
        return None
    first = draw.any(names)
    second = draw.any([name for name in names if name != first])
    return ET.SubElement(
        scene.sensor, kind, geom1=first, geom2=second, cutoff=draw.any(("0.3", "2"))
    )


def _of_contacts(scene: Scene, draw: Draw) -> ET.Element:
    sensor = ET.SubElement(scene.sensor, "contact", data=draw.any(DATA))
    sensor.set("reduce", draw.kind("reduce", REDUCES))
    sensor.set("num", draw.any(("1", "3")))
    of = draw.any(("geom", "body", "subtree", "all"))
    if of == "geom":
        sensor.set("geom1", draw.any(scene.moving_geoms))
    elif of != "all":
        sensor.set(f"{of}1", draw.any(scene.bodies))
    return sensor


def _of_site(scene: Scene, draw: Draw, kind: str) -> ET.Element | None:
    if not scene.moving_sites:
        return None
    site = draw.any(scene.moving_sites)
    if kind == "camprojection":
        return (
            ET.SubElement(scene.sensor, kind, site=site, camera=scene.cameras[0])
            if scene.cameras
            else None
        )
    if kind == "insidesite":
        return ET.SubElement(
            scene.sensor, kind, site=site, objtype="body", objname=draw.any(scene.bodies)
        )
    return ET.SubElement(scene.sensor, kind, site=site)
