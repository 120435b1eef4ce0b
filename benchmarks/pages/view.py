"""Makes docs/view.md, what terms can read, from the properties and docstrings of the view and its parts."""

import ast
import inspect
import re
from typing import NamedTuple

from benchmarks.pages.table import table
from ksim_rl.config.field_texts import attribute_texts
from ksim_rl.envs import EnvView
from ksim_rl.scene.motions.motion import ReferenceMotion
from ksim_rl.scene.sensors import (
    CameraTracker,
    ContactPointsState,
    ContactState,
    ImuTracker,
    RayTracker,
    SensorTracker,
)
from ksim_rl.scene.sensors.rays import RayState
from ksim_rl.scene.state.elements import Bodies, Body, Joints, Site, Sites
from ksim_rl.scene.state.entity import Entity, GroundScan
from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.state.quantity import FirstOf, QuantityOf

HEAD = """# What a term can read

A term is called with the view of its env. This page lists what the view has, made of the code's own docstrings; terms
that read it are in [terms](terms.md), and [own_task.md](own_task.md#3-a-term) shows how one is written. A name that
does not exist is refused with the near ones.

Shapes have the letters of [concepts](concepts.md#words): `E` envs, `L` joints or other numbers of a vector, `N` bodies,
sites, elements or rays. Values are float32 unless a type stands before the shape. Quaternions are (w, x, y, z).
Position- and velocity-stage values belong to the current state. Acceleration-stage ones belong to the last physics
substep, and read zero in rows that were just reset. A value without a stage follows no physics: clocks, tables, what
managers keep.

What you read is not yours to write ([terms are pure](own_task.md#terms-are-pure))."""


class Part(NamedTuple):
    """A class with a table on the page: how a term spells an object of it, and what that is."""

    spelled: str
    owner: type
    what: str


PARTS = (
    Part(
        "view",
        EnvView,
        "The env itself. Without a name, quantities are of all joints and of the first robot.",
    ),
    Part(
        'view.joints("hip.*")', Joints, "Some hinges and slides, by names or regular expressions."
    ),
    Part('view.bodies(".*_foot")', Bodies, "Some bodies."),
    Part('view.body("torso")', Body, "One body."),
    Part('view.sites(".*_foot")', Sites, "Some sites."),
    Part('view.site("finger")', Site, "One site."),
    Part(
        'view.entity("cube")',
        Entity,
        "A robot or object of the scene; `view.robot` is the first.",
    ),
    Part(
        "view.robot.ground_scan(points)", GroundScan, "The ground at points about an entity's root."
    ),
    Part('view.contact("feet")', ContactState, "A `ContactSensor` of `scene.sensors`."),
    Part(
        'view.contact_points("hand")', ContactPointsState, "A `ContactPoints` of `scene.sensors`."
    ),
    Part('view.imu("imu")', ImuTracker, "An `ImuSensor` of `scene.sensors`."),
    Part('view.rays("scan")', RayTracker, "A `RayCaster` of `scene.sensors`."),
    Part('view.rays("scan").state', RayState, "Its hits."),
    Part('view.camera("front")', CameraTracker, "A `CameraSensor` of `scene.sensors`."),
    Part("view.terrain", Ground, "The ground under each env."),
    Part('view.motion("walk.npz")', ReferenceMotion, "A reference motion; `F` are its frames."),
)
# Longer ones first, since a search takes the first that fits.
ROTATIONS = ("(w, x, y, z)",)
OF_JOINTS = ("rad/s^2 or m/s^2", "rad/s or m/s", "rad or m", "N m or N")
UNITS = (*ROTATIONS, *OF_JOINTS, "m/s^2", "rad/s", "m/s", "rad", "m", "s", "N")
_UNIT = re.compile(rf", ({'|'.join(re.escape(unit) for unit in UNITS)})(?=[,.;]|$)")
_FRAME = re.compile(r", (world|body|sensor) frame(?=[,.;:]|$)")
_STAGE = re.compile(r"[;,] (position|velocity|acceleration) stage")
_BRACKETS = re.compile(r",? ?(bool |int64 )?\[([EL][^\]]*|)\]( each)?")


class Row(NamedTuple):
    """A line of a table."""

    name: str
    shape: str
    what: str
    unit: str
    frame: str
    stage: str


def rows(owner: type) -> list[Row]:
    """Return what an object of a class has to read: its properties, then attributes that its docstring lists."""
    texts = attribute_texts(owner)
    fields = _field_strings(owner)
    texts.update(fields)
    shapes = {name: _spelled(hint) for name, hint in inspect.get_annotations(owner).items()}
    for name, member in _members(owner).items():
        if isinstance(member, property):
            texts[name] = (member.__doc__ or "").split("\n\n")[0]
            shapes[name] = _shape_of(member)
    # All fields of a reading are of one stage, which its own docstring names.
    of_all = _STAGE.search((inspect.getdoc(owner) or "").replace("(", ", ")) if fields else None
    made = []
    for name, text in texts.items():
        bracket = _BRACKETS.search(text)
        in_text = f"{bracket[1] or ''}[{bracket[2]}]" if bracket else ""
        shape = shapes.get(name) or in_text or _by_suffix(name)
        stage = _STAGE.search(text) or of_all
        made.append(_row(name, shape, text, stage[1] if stage else ""))
    return made


def methods(owner: type) -> list[tuple[str, str]]:
    """Return the signature and the first line of each public method that an object has, in the order of the code."""
    found = []
    for name, method in _members(owner).items():
        # What runs a sensor is no matter of terms.
        if not inspect.isfunction(method) or name in vars(SensorTracker):
            continue
        parameters = [str(one) for one in inspect.signature(method).parameters if one != "self"]
        text = (inspect.getdoc(method) or "").split("\n\n")[0]
        found.append((f"`{name}({', '.join(parameters)})`", " ".join(text.split())))
    return found


def _members(owner: type) -> dict[str, object]:
    """Return the public members of a class and its bases in the order of the code, bases first."""
    found: dict[str, object] = {}
    for base in reversed(owner.__mro__):
        found.update(
            {name: member for name, member in vars(base).items() if not name.startswith("_")}
        )
    return found


def page() -> str:
    """Return the page: for each part a table of quantities, and one of methods."""
    parts = [HEAD]
    for part in PARTS:
        parts.append(f"## `{part.spelled}`\n\n{part.what}")
        cells = [(f"`{row.name}`", *row[1:]) for row in rows(part.owner)]
        parts.append(table(("name", "shape", "what", "unit", "frame", "stage"), cells))
        called = methods(part.owner)
        if called:
            parts.append(table(("method", "what it does"), called))
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _row(name: str, shape: str, text: str, stage: str) -> Row:
    text = _BRACKETS.sub("", " ".join(text.split()), count=1)
    unit = _UNIT.search(text)
    frame = _FRAME.search(text)
    # What has a column of its own need not stand in the text.
    for pattern in (_STAGE, _UNIT, _FRAME):
        text = pattern.sub("", text, count=1)
    text = text.strip(" .;,")
    text = text[:1].upper() + text[1:]
    return Row(
        name,
        f"`{shape}`" if shape else "",
        text,
        unit[1] if unit else "",
        frame[1] if frame else "",
        stage,
    )


def _shape_of(member: property) -> str:
    """Return the shape of a property; where it passes a quantity on, the quantity's."""
    if isinstance(member, QuantityOf):
        return _shape_of(member.whole)
    if isinstance(member, FirstOf):
        # One of N elements.
        return _shape_of(member.whole).replace(" N,", "").replace(", N", "")
    assert member.fget is not None
    return _spelled(inspect.get_annotations(member.fget).get("return"))


def _spelled(hint: object) -> str:
    """Return a jaxtyping annotation as a shape, with the type before it where that is not float32."""
    dims = getattr(hint, "dim_str", None)
    if dims is None:
        return ""
    kind = type(hint).__name__ if not isinstance(hint, type) else hint.__name__
    kind = kind.partition("[")[0].lower()
    # "?" of jaxtyping says that a size may differ, which is no matter of the reader's.
    shape = f"[{', '.join(dims.replace('?', '').split())}]"
    return shape if kind == "float" else f"{kind} {shape}"


def _by_suffix(name: str) -> str:
    """Return the shape that the name of a tensor ends in: "[E, L]" of "action_EL"."""
    suffix = re.search(r"_([A-Z][A-Z0-9]*)$", name)
    return f"[{', '.join(suffix[1])}]" if suffix else ""


def _field_strings(owner: type) -> dict[str, str]:
    """Return the strings that stand below the fields of a named tuple, by field."""
    if not hasattr(owner, "_fields"):
        return {}
    # Its class is the only statement of its source.
    body = ast.parse(inspect.getsource(owner)).body[0].body  # type: ignore[attr-defined]
    found = {}
    for field, below in zip(body, body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
            found[field.target.id] = " ".join(below.value.value.split())  # type: ignore[union-attr]
    return found
