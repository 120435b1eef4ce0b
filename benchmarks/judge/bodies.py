"""Trees of bodies with random joints and geoms, things that are fixed to the world, and what mocap moves."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence

from benchmarks.judge.draw import Draw, written
from benchmarks.judge.scene import Scene

TREES = ("arm", "branches", "free", "free_with_children", "several_joints", "slides")
JOINTS = ("hinge", "slide", "ball")
GEOMS = ("sphere", "capsule", "box", "ellipsoid", "cylinder", "mesh")
# Which of them collide by formulas of their own; contacts of the others, found by iterations, are few.
EXACT = ("sphere", "capsule", "box")
MOST_DOFS = 14
HFIELD_MARGIN = "1e-6"
_MESH = "0.08 0 0 -0.05 0.07 0 -0.06 -0.06 0.01 0 0.01 0.09 0.02 -0.01 -0.07 0.03 0.05 0.04"
_GROUND = "0 0.3 0.1 0.4 0.2 0.9 0.6 0.1 0.3 0.5 1 0.2 0.1 0.4 0.3 0"


def add_bodies(scene: Scene, draw: Draw) -> None:
    """Add the world's own geoms, one to three trees, and at times a body that mocap moves."""
    _add_fixed(scene, draw)
    kinds = draw.kinds("tree", TREES, int(draw.rng.integers(1, 4)))
    dofs = 0
    for place, kind in enumerate(kinds):
        # Side by side, so near that some touch.
        x, y = 0.32 * (place % 2), 0.32 * (place // 2)
        dofs += _add_tree(scene, draw, kind, (x, y))
        if dofs >= MOST_DOFS:
            break
    if draw.takes("mocap", 0.2):
        body = ET.SubElement(scene.worldbody, "body", name="mocap", mocap="true", pos="-0.3 0 0.2")
        scene.mocaps.append("mocap")
        _add_geom(scene, draw, body, moves=False)
        _add_site(scene, draw, body, moves=False)
        if draw.takes("child_of_mocap", 0.4):
            child = ET.SubElement(body, "body", name="mocap_child", pos="0.05 0 0.05")
            _add_geom(scene, draw, child, moves=False)


def _add_fixed(scene: Scene, draw: Draw) -> None:
    ground = draw.kind("ground", ("plane", "plane", "plane", "plane", "box", "hfield", "none"))
    if ground == "plane":
        attributes = {"type": "plane", "size": "3 3 0.1"}
    elif ground == "box":
        attributes = {"type": "box", "size": "2 2 0.1", "pos": "0 0 -0.1"}
    elif ground == "hfield":
        ET.SubElement(
            scene.asset,
            "hfield",
            name="ground",
            nrow="4",
            ncol="4",
            size="1 1 0.1 0.1",
            elevation=_GROUND,
        )
        # With a margin of 0, depths of C itself are off by centimetres (docs/upstream.md).
        attributes = {
            "type": "hfield",
            "hfield": "ground",
            "pos": "0 0 -0.05",
            "margin": HFIELD_MARGIN,
        }
    else:
        attributes = {}
    if attributes:
        geom = ET.SubElement(scene.worldbody, "geom", attributes, name="ground")
        scene.geoms.setdefault(ground, []).append("ground")
        _add_surface(draw, geom)
    # Always there, for tendons and sensors.
    ET.SubElement(scene.worldbody, "site", name="anchor", pos="0.1 0.1 0.6")
    scene.sites.append("anchor")
    if draw.takes("static_body", 0.4):
        body = ET.SubElement(
            scene.worldbody,
            "body",
            name="static",
            pos=f"{draw.number(0.0, 0.4)} 0.1 0.05",
            quat=draw.quat(0.1),
        )
        _add_geom(scene, draw, body, moves=False)
        _add_site(scene, draw, body, moves=False)
        if draw.takes("static_child", 0.5):
            child = ET.SubElement(
                body, "body", name="static_child", pos="0 0.05 0.05", quat=draw.quat(0.1)
            )
            _add_geom(scene, draw, child, moves=False)
    if draw.takes("camera", 0.2):
        mode = draw.kind("camera", ("fixed", "track", "trackcom"))
        ET.SubElement(
            scene.worldbody,
            "camera",
            name="eye",
            pos="0 -1 0.5",
            xyaxes="1 0 0 0 0.5 1",
            mode=mode,
            resolution="4 4",
        )
        scene.cameras.append("eye")
    if draw.takes("light", 0.1):
        ET.SubElement(scene.worldbody, "light", pos="0 0 2", mode="fixed")


def _add_tree(scene: Scene, draw: Draw, kind: str, place: tuple[float, float]) -> int:
    """Add a tree, and return its number of degrees of freedom."""
    height = (
        draw.rng.uniform(0.03, 0.12) if kind.startswith("free") else draw.rng.uniform(0.05, 0.25)
    )
    body = _add_body(scene, draw, scene.worldbody, written((*place, height)))
    if kind.startswith("free"):
        joint = ET.SubElement(body, "freejoint", name=f"free{len(scene.joints.get('free', []))}")
        scene.joints.setdefault("free", []).append(joint.get("name", ""))
        dofs = 6
    elif kind == "slides":
        count = int(draw.rng.integers(2, 4))
        axes = ("1 0 0", "0 1 0", "0 0 1")
        turned = draw.takes("slides_askew", 0.3)
        for axis in axes[:count]:
            _add_joint(
                scene, draw, body, "slide", axis=draw.axis() if turned and axis == axes[0] else axis
            )
        dofs = count
    elif kind == "several_joints":
        dofs = sum(
            _add_joint(scene, draw, body, draw.kind("joint", ("hinge", "slide"))) for _ in range(2)
        )
        if draw.takes("ball_after_slide", 0.3):
            dofs += _add_joint(scene, draw, body, "ball")
    else:
        dofs = _add_joint(scene, draw, body, draw.kind("joint", JOINTS))
    _fill(scene, draw, body)
    if kind == "free":
        return dofs
    ends = [body]
    children = (
        int(draw.rng.integers(1, 3)) if kind in ("arm", "free_with_children", "branches") else 0
    )
    for _ in range(children):
        above = ends[0] if kind == "branches" else ends[-1]
        child = _add_body(scene, draw, above, written(draw.rng.uniform(-0.15, 0.15, size=3)))
        dofs += _add_joint(scene, draw, child, draw.kind("joint", JOINTS))
        _fill(scene, draw, child)
        ends.append(child)
    if draw.takes("tool", 0.25):
        tool = _add_body(scene, draw, ends[-1], "0.05 0.03 -0.04")
        scene.tools.append(tool.get("name", ""))
        _fill(scene, draw, tool)
    return dofs


def _add_body(scene: Scene, draw: Draw, above: ET.Element, pos: str) -> ET.Element:
    name = f"body{len(scene.bodies)}"
    body = ET.SubElement(above, "body", name=name, pos=pos)
    scene.bodies.append(name)
    if draw.takes("body_quat", 0.3):
        body.set("quat", draw.quat())
    if draw.takes("gravcomp", 0.1):
        body.set("gravcomp", draw.number(0.2, 1.2))
    return body


def _fill(scene: Scene, draw: Draw, body: ET.Element) -> None:
    """Give a body that moves its mass, its geoms and a site."""
    for _ in range(1 + int(draw.rng.random() < 0.25)):
        _add_geom(scene, draw, body, moves=True)
    if draw.takes("inertial", 0.15):
        ET.SubElement(
            body,
            "inertial",
            pos=draw.numbers(-0.02, 0.02, 3),
            quat=draw.quat(),
            mass=draw.number(0.3, 1.5),
            diaginertia=draw.numbers(0.004, 0.006, 3),
        )
    _add_site(scene, draw, body, moves=True)


def _add_site(scene: Scene, draw: Draw, body: ET.Element, *, moves: bool) -> None:
    name = f"site{len(scene.sites)}"
    kind = draw.any(("sphere", "box", "capsule", "cylinder", "ellipsoid"))
    ET.SubElement(
        *(body, "site"),
        name=name,
        type=kind,
        size=draw.numbers(0.05, 0.12, 3),
        pos=draw.numbers(-0.05, 0.05, 3),
        quat=draw.quat(),
    )
    scene.sites.append(name)
    if moves:
        scene.moving_sites.append(name)


def _add_joint(
    scene: Scene, draw: Draw, body: ET.Element, kind: str, axis: str | None = None
) -> int:
    """Add a joint, and return its number of degrees of freedom."""
    draw.taken.add(f"joint.{kind}")
    names = scene.joints.setdefault(kind, [])
    joint = ET.SubElement(body, "joint", name=f"{kind}{len(names)}", type=kind)
    name = joint.get("name", "")
    names.append(name)
    if kind != "ball":
        joint.set("axis", axis or draw.axis())
    if kind != "slide" and draw.takes("joint_pos", 0.3):
        joint.set("pos", draw.numbers(-0.05, 0.05, 3))
    if draw.takes("damping", 0.6):
        joint.set("damping", draw.number(0.05, 0.5))
    if draw.takes("damping_poly", 0.05):
        joint.set("damping", draw.numbers(0.01, 0.3, 3))
    if draw.takes("armature", 0.4):
        joint.set("armature", draw.number(0.005, 0.05))
    if draw.takes("stiffness", 0.3):
        joint.set("stiffness", draw.number(1.0, 10.0))
        if kind != "ball" and draw.takes("springref", 0.5):
            joint.set("springref", draw.number(-0.2, 0.2))
        if kind != "ball" and draw.takes("springyield", 0.1):
            joint.set("springyield", "0.05")
    if draw.takes("joint_frictionloss", 0.15):
        joint.set("frictionloss", draw.number(0.05, 0.3))
    if draw.takes("limit", 0.35):
        _add_limit(scene, draw, joint, kind)
    if kind != "ball" and draw.takes("joint_forcerange", 0.1):
        joint.set("actuatorfrcrange", "-0.6 0.5")
        if draw.takes("actuatorgravcomp", 0.3):
            joint.set("actuatorgravcomp", "true")
    if kind != "ball" and draw.takes("joint_ref", 0.1):
        joint.set("ref", "0.1")
    return 3 if kind == "ball" else 1


def _add_limit(scene: Scene, draw: Draw, joint: ET.Element, kind: str) -> None:
    reach = 0.1 if kind == "slide" else 0.4
    low, high = -draw.rng.uniform(0.2, 1.0) * reach, draw.rng.uniform(0.2, 1.0) * reach
    if kind == "ball":
        low = 0.0
    joint.set("range", written((low, high)))
    scene.limited_joints.append(joint.get("name", ""))
    if draw.takes("limit_margin", 0.3):
        joint.set("margin", draw.number(0.01, 0.1))
    if kind != "ball" and draw.takes("narrow_limit", 0.15):
        joint.set("range", "-0.02 0.03")
        joint.set("margin", "0.05")
    if draw.takes("limit_solref", 0.3):
        joint.set("solreflimit", draw.any(("0.03 1", "0.05 0.8", "-300 -10")))
    if draw.takes("limit_solimp", 0.2):
        joint.set("solimplimit", "0.8 0.95 0.02 0.4 3")


def _add_geom(scene: Scene, draw: Draw, body: ET.Element, *, moves: bool) -> None:
    kind = draw.kind("geom", (*EXACT, *EXACT, *GEOMS[len(EXACT) :]))
    names = scene.geoms.setdefault(kind, [])
    geom = ET.SubElement(body, "geom", name=f"{kind}{len(names)}", type=kind)
    name = geom.get("name", "")
    names.append(name)
    if kind == "mesh":
        if scene.asset.find("mesh") is None:
            ET.SubElement(scene.asset, "mesh", name="stone", vertex=_MESH)
        geom.set("mesh", "stone")
    else:
        size = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)
        geom.set("size", draw.numbers(0.03, 0.09, size))
    if draw.takes("geom_pose", 0.5):
        geom.set("pos", draw.numbers(-0.05, 0.05, 3))
        geom.set("quat", draw.quat())
    if moves:
        scene.moving_geoms.append(name)
        geom.set("mass", draw.number(0.2, 1.5))
    if kind not in EXACT and not draw.takes("collides_by_iteration", 0.3):
        geom.set("contype", "0")
        geom.set("conaffinity", "0")
    elif draw.takes("contype", 0.1):
        geom.set("contype", "2")
        geom.set("conaffinity", "3")
    if draw.takes("fluid_shape", 0.05):
        geom.set("fluidshape", "ellipsoid")
    _add_surface(draw, geom)


def _add_surface(draw: Draw, geom: ET.Element) -> None:
    """Give a geom what decides the contacts that it makes."""
    settings: Sequence[tuple[str, float, str, Sequence[str]]] = (
        ("condim", 0.4, "condim", ("1", "3", "4", "6")),
        ("friction", 0.4, "friction", ("0.8 0.02 0.01", "0.3 0.005 0.001", "1.2 0.01 0.02")),
        ("solref", 0.2, "solref", ("0.03 1", "0.04 0.7")),
        ("direct_solref", 0.1, "solref", ("-800 -20", "-2000 -30")),
        ("solimp", 0.2, "solimp", ("0.8 0.95 0.01 0.4 3", "0.5 0.9 0.02")),
        ("margin", 0.15, "margin", ("0.01", "0.02")),
        ("gap", 0.1, "gap", ("0.005", "0.01")),
        ("priority", 0.15, "priority", ("1", "2")),
        ("solmix", 0.15, "solmix", ("0.3", "2")),
        ("geom_adhesion", 0.05, "adhesion", ("1", "3")),
        ("surfacevel", 0.05, "surfacevel", ("0.3 0 0 0 0 0", "0 0.2 0 0 0 1")),
    )
    # Of what is tilted on a height field, C's distances within a margin are off by margin and gap.
    without = ("margin", "gap") if "ground.hfield" in draw.taken else ()
    for feature, chance, attribute, values in settings:
        if feature not in without and draw.takes(feature, chance):
            geom.set(attribute, draw.any(values))
