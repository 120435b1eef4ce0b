"""Random tendons, equality constraints, and pairs of geoms that do or do not touch."""

import xml.etree.ElementTree as ET

from benchmarks.judge.draw import Draw
from benchmarks.judge.scene import Scene

EQUALITIES = (
    "connect",
    "connect_sites",
    "weld",
    "weld_sites",
    "weld_world",
    "joint",
    "joint_alone",
    "tendon",
)


def add_tendons(scene: Scene, draw: Draw) -> None:
    """Add a tendon over joints and one over sites and geoms, if the model has any."""
    scalars = scene.scalars()
    if scalars and draw.takes("tendon.fixed", 0.25):
        tendon = ET.SubElement(scene.tendon, "fixed", name="strap")
        for joint in scalars[:3]:
            ET.SubElement(tendon, "joint", joint=joint, coef=draw.number(-1.5, 1.5))
        scene.fixed_tendons.append("strap")
        _add_properties(scene, draw, tendon, ("-0.1", "0.1"))
    if scene.moving_sites and draw.takes("tendon.spatial", 0.25):
        _add_spatial(scene, draw)


def _add_spatial(scene: Scene, draw: Draw) -> None:
    tendon = ET.SubElement(scene.tendon, "spatial", name="cable")
    ET.SubElement(tendon, "site", site="anchor")
    around = scene.geoms.get("sphere", []) + scene.geoms.get("cylinder", [])
    if around and draw.takes("tendon.wrap", 0.5):
        wrap = ET.SubElement(tendon, "geom", geom=draw.any(around))
        if draw.takes("tendon.sidesite", 0.3):
            wrap.set("sidesite", draw.any(scene.sites))
    ET.SubElement(tendon, "site", site=draw.any(scene.moving_sites))
    if draw.takes("tendon.pulley", 0.2):
        ET.SubElement(tendon, "pulley", divisor="2")
        ET.SubElement(tendon, "site", site=scene.moving_sites[0])
        ET.SubElement(tendon, "site", site="anchor")
    scene.spatial_tendons.append("cable")
    _add_properties(scene, draw, tendon, ("0.1", draw.number(0.2, 0.7)))


def _add_properties(scene: Scene, draw: Draw, tendon: ET.Element, limits: tuple[str, str]) -> None:
    if draw.takes("tendon.limit", 0.4):
        tendon.set("range", " ".join(limits))
        scene.limited_tendons.append(tendon.get("name", ""))
        if draw.takes("tendon.margin", 0.3):
            tendon.set("margin", "0.05")
        if draw.takes("tendon.solreflimit", 0.3):
            tendon.set("solreflimit", "0.04 0.9")
    if draw.takes("tendon.stiffness", 0.4):
        tendon.set("stiffness", draw.number(1.0, 20.0))
        if draw.takes("tendon.springlength", 0.4):
            tendon.set("springlength", "0.1 0.2")
    if draw.takes("tendon.damping", 0.4):
        tendon.set("damping", draw.number(0.05, 1.0))
    if draw.takes("tendon.frictionloss", 0.2):
        tendon.set("frictionloss", draw.number(0.05, 0.5))
    wraps = tendon.tag == "spatial" and tendon.find("geom") is not None
    if not wraps and draw.takes("tendon.armature", 0.25):
        tendon.set("armature", draw.number(0.01, 0.1))
    if draw.takes("tendon.forcerange", 0.15):
        tendon.set("actuatorfrcrange", "-0.3 0.4")


def add_equalities(scene: Scene, draw: Draw) -> None:
    """Add ties of bodies, joints and tendons."""
    if not (draw.wants_some_of("equality") or draw.rng.random() < 0.3):
        return
    for number, kind in enumerate(
        draw.kinds("equality", EQUALITIES, 1 + int(draw.rng.random() < 0.3))
    ):
        tie = _equality(scene, draw, kind)
        if tie is None:
            draw.taken.discard(f"equality.{kind}")
            continue
        tie.set("name", f"tie{number}")
        if draw.takes("equality_solref", 0.4):
            tie.set("solref", draw.any(("0.04 1", "0.03 0.8", "-300 -15")))
        if draw.takes("equality_inactive", 0.1):
            tie.set("active", "false")


def _equality(scene: Scene, draw: Draw, kind: str) -> ET.Element | None:
    """Add a tie of some kind; None where the model has nothing to tie so."""
    section, scalars, bodies = scene.equality, scene.scalars(), scene.bodies
    first, last = bodies[0], (scene.tools or bodies)[-1]
    if kind.endswith("_sites"):
        if len(scene.moving_sites) < 2:
            return None
        ends = {"site1": scene.moving_sites[0], "site2": scene.moving_sites[-1]}
        return ET.SubElement(section, kind.partition("_")[0], ends)
    if kind == "weld_world":
        return ET.SubElement(section, "weld", body1=last)
    if kind in ("connect", "weld"):
        if first == last:
            return None
        tie = ET.SubElement(section, kind, body1=last, body2=first)
        if kind == "connect":
            tie.set("anchor", "0.02 0.01 0")
        elif draw.takes("torquescale", 0.4):
            tie.set("torquescale", "0.5")
        return tie
    if kind == "joint_alone" and scalars:
        return ET.SubElement(section, "joint", joint1=scalars[0], polycoef="0.05 0 0 0 0")
    if kind == "joint" and len(scalars) > 1:
        return ET.SubElement(
            section,
            "joint",
            joint1=scalars[0],
            joint2=scalars[-1],
            polycoef="0.02 0.5 0.2 -0.1 0.3",
        )
    tendons = scene.fixed_tendons + scene.spatial_tendons
    if kind == "tendon" and tendons:
        tie = ET.SubElement(section, "tendon", tendon1=tendons[0])
        if len(tendons) > 1:
            tie.set("tendon2", tendons[1])
        tie.set("polycoef", "0.01 0.5 0 0 0")
        return tie
    return None


def add_pairs(scene: Scene, draw: Draw) -> None:
    """Add pairs of geoms with contact settings of their own, and bodies that do not touch."""
    exact = [name for kind in ("sphere", "capsule", "box") for name in scene.geoms.get(kind, [])]
    moving = [name for name in exact if name in scene.moving_geoms]
    others = [*scene.geoms.get("plane", []), *exact]
    if moving and draw.takes("pair", 0.25):
        own = draw.any(moving)
        others = [name for name in others if name != own]
        if others:
            other = draw.any(others)
            _add_pair(scene, draw, own, other)
            if draw.takes("pair_twice", 0.3):
                _add_pair(scene, draw, own, other)
                # Which most things reach, so that both pairs make contacts.
                for pair in scene.contact if scene.geoms.get("plane") else ():
                    pair.set("geom2", "ground")
    if len(scene.bodies) > 1 and draw.takes("exclude", 0.15):
        ET.SubElement(scene.contact, "exclude", body1=scene.bodies[0], body2=scene.bodies[-1])


def _add_pair(scene: Scene, draw: Draw, own: str, other: str) -> None:
    pair = ET.SubElement(
        scene.contact, "pair", geom1=own, geom2=other, condim=draw.any(("1", "3", "4", "6"))
    )
    pair.set("friction", draw.any(("0.5 0.4 0.01 0.002 0.003", "1 1 0.02 0.001 0.001")))
    if draw.takes("pair_margin", 0.3):
        pair.set("margin", "0.02")
        pair.set("gap", draw.any(("0", "0.01")))
    if draw.takes("pair_solref", 0.4):
        pair.set("solref", draw.any(("0.03 1", "-900 -30")))
    if draw.takes("solreffriction", 0.3):
        pair.set("solreffriction", "0.04 1.1")
