"""Random actuators: all kinds, on all that they can pull."""

import xml.etree.ElementTree as ET

from benchmarks.judge.draw import Draw
from benchmarks.judge.scene import Scene

TRANSMISSIONS = (
    "joint",
    "joint",
    "jointinparent",
    "slidercrank",
    "tendon",
    "site",
    "refsite",
    "body",
)
SCALAR = (
    "motor",
    "position",
    "velocity",
    "intvelocity",
    "damper",
    "cylinder",
    "muscle",
    "general",
    "filter",
    "filterexact",
    "integrator",
    "dcmotor",
)
GROUPS = ("0", "1", "2")


def add_actuators(scene: Scene, draw: Draw) -> None:
    """Add up to three actuators, and those that are wanted."""
    count = int(draw.rng.integers(0, 4))
    wanted = draw.wants_some_of("transmission") or draw.wants_some_of("actuator")
    if not count and wanted:
        count = 1
    kinds = draw.kinds("transmission", TRANSMISSIONS, count) if count else []
    # A kind that is wanted needs something that it can pull.
    if draw.wants_some_of("actuator") and not set(kinds) & {"joint", "tendon"}:
        kinds.append("joint")
    for transmission in kinds:
        _add_actuator(scene, draw, transmission)


def _add_actuator(scene: Scene, draw: Draw, transmission: str) -> None:
    where = _places(scene, draw, transmission)
    if where is None:
        draw.taken.discard(f"transmission.{transmission}")
        return
    number = len(scene.actuators)
    actuator = _element(scene, draw, transmission, where)
    actuator.set("name", f"actuator{number}")
    scene.actuators.append(f"actuator{number}")
    actuator.set("group", draw.any(GROUPS))
    if transmission in ("site", "refsite"):
        actuator.set("gear", draw.numbers(-1.0, 1.0, 6))
    elif transmission == "joint" and where["joint"].startswith(("ball", "free")):
        actuator.set("gear", draw.numbers(-1.0, 1.0, 3 if where["joint"].startswith("ball") else 6))
    elif transmission != "body" and draw.takes("gear", 0.5):
        actuator.set("gear", draw.number(0.5, 2.0))
    one_control = actuator.tag != "dcmotor"
    ranged = actuator.get("ctrlrange") is not None
    if one_control and not ranged and actuator.tag != "muscle" and draw.takes("ctrlrange", 0.4):
        actuator.set("ctrlrange", "-0.6 0.5")
    if actuator.tag not in ("adhesion", "dcmotor") and draw.takes("forcerange", 0.25):
        actuator.set("forcerange", "-0.5 0.7")
    of_joint = transmission == "joint" and where["joint"].startswith(("hinge", "slide"))
    if of_joint and actuator.tag != "muscle" and draw.takes("actuator_armature", 0.15):
        actuator.set("armature", draw.number(0.01, 0.1))
    if of_joint and actuator.tag != "muscle" and draw.takes("actuator_damping", 0.1):
        actuator.set("damping", draw.number(0.05, 0.3))
    if one_control and actuator.tag != "adhesion" and draw.takes("actuator_delay", 0.1):
        actuator.set("delay", "0.01")
        actuator.set("nsample", "4")
        if draw.takes("actuator_interp", 0.5):
            actuator.set("interp", draw.any(("zoh", "linear", "cubic")))


def _places(scene: Scene, draw: Draw, transmission: str) -> dict[str, str] | None:
    """Return the attributes that say what an actuator pulls; None where the model has no such thing."""
    joints = [name for names in scene.joints.values() for name in names]
    tendons, sites = scene.fixed_tendons + scene.spatial_tendons, scene.moving_sites
    if transmission == "joint" and joints:
        # Kinds of actuators that are wanted pull one coordinate, as our kernels do.
        scalars = scene.scalars()
        if draw.barred:
            return {"joint": draw.any(scalars)} if scalars else None
        choices = scalars if scalars and draw.wants_some_of("actuator") else joints
        return {"joint": draw.any(choices)}
    if transmission == "jointinparent" and joints:
        return {"jointinparent": draw.any(joints)}
    if transmission == "tendon" and tendons:
        return {"tendon": draw.any(tendons)}
    if transmission == "body":
        return {"body": draw.any(scene.bodies)}
    if transmission == "slidercrank" and len(sites) > 1:
        return {"cranksite": sites[0], "slidersite": sites[-1], "cranklength": "0.4"}
    if transmission == "site" and sites:
        return {"site": draw.any(sites)}
    if transmission == "refsite" and sites:
        return {"site": draw.any(sites), "refsite": "anchor"}
    return None


def _element(scene: Scene, draw: Draw, transmission: str, where: dict[str, str]) -> ET.Element:
    section = scene.actuator
    if transmission == "body":
        return ET.SubElement(
            section, "adhesion", where, ctrlrange="0 1", gain=draw.number(1.0, 6.0)
        )
    one_coordinate = transmission in ("joint", "tendon") and not where.get("joint", "").startswith(
        ("ball", "free")
    )
    if not one_coordinate:
        kind = draw.kind("actuator", ("motor", "position", "general"))
    else:
        kind = draw.kind("actuator", SCALAR)
    attributes = {
        "motor": {},
        "position": {"kp": draw.number(1.0, 15.0), "kv": draw.number(0.0, 0.5)},
        "velocity": {"kv": draw.number(0.1, 1.0)},
        "intvelocity": {"kp": draw.number(1.0, 10.0), "actrange": "-0.5 0.5"},
        "damper": {"kv": draw.number(0.1, 0.8), "ctrlrange": "0 1"},
        "cylinder": {"timeconst": "0.05", "area": "1.5", "bias": "0.1 -1 -0.1"},
        "muscle": {"lengthrange": "-0.5 0.8", "force": "2"},
        "dcmotor": {"motorconst": "0.4", "resistance": "1.5"},
    }
    if kind in attributes:
        return ET.SubElement(section, kind, where, **attributes[kind])
    general = ET.SubElement(section, "general", where, gainprm=draw.number(0.5, 2.0))
    if kind != "general":
        general.set("dyntype", kind)
        general.set("dynprm", "0.04")
        if draw.takes("actlimited", 0.4):
            general.set("actrange", "-0.3 0.4")
        if draw.takes("actearly", 0.3):
            general.set("actearly", "true")
    if draw.takes("affine_gain", 0.25):
        general.set("gaintype", "affine")
        general.set("gainprm", "1 0.3 -0.05")
    if draw.takes("affine_bias", 0.5):
        general.set("biastype", "affine")
        general.set("biasprm", draw.numbers(-1.0, 0.0, 3))
    return general
