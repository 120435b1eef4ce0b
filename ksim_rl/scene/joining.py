"""Joins the models of several entities into one, and checks that none of them has changed by it."""

import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from ksim_rl.physics import load_model
from ksim_rl.physics.load import caught_warnings
from ksim_rl.scene.keyframes import add_joined
from ksim_rl.scene.state.default_state import default_data

# Elements by the prefix of their fields in mjModel, with the name of their count.
COUNTS = {
    "body": "nbody",
    "jnt": "njnt",
    "dof": "nv",
    "geom": "ngeom",
    "site": "nsite",
    "tendon": "ntendon",
    "actuator": "nu",
    "eq": "neq",
    "sensor": "nsensor",
    "pair": "npair",
}
# Places in other arrays, which a joined model has elsewhere, and fields that only pictures or users read.
PLACES = re.compile(r".*(id|adr|num|user|plugin|sameframe|simple|signature|geom1|geom2|rgba)")
# Sums over a tree depend on the order of its bodies in the last digits.
TOLERANCE = 1e-9


class _Part(NamedTuple):
    """An entity alone, compiled."""

    name: str
    mj_model: mujoco.MjModel


def joined(entities: Mapping[str, mujoco.MjSpec]) -> mujoco.MjSpec:
    """Put entities into one spec, with one keyframe that joins the first one of each.

    A ValueError names the field in which an entity differs from its own model.
    """
    spec = mujoco.MjSpec()
    first = next(iter(entities.values()))
    # A model has one set of options: the first entity's.
    spec.option = first.option
    parts: list[_Part] = []
    for name, entity in entities.items():
        entity.option = first.option
        # The joined model keeps all bodies and geoms: fusing and discarding change no motion.
        entity.compiler.fusestatic = False
        entity.compiler.discardvisual = False
        # Alone, with the common options: the model that the joined one is compared with.
        parts.append(_Part(name, load_model(entity)))
        _keep_masses(entity, parts[-1].mj_model)
        # An attached keyframe would cover its own entity only.
        for key in list(entity.keys):
            entity.delete(key)
        # The view knows whose a body is by the name of its outermost ancestor.
        for number, body in enumerate(entity.worldbody.bodies):
            body.name = body.name or f"body{number}"
        # Prefixes keep apart elements of the same name; the frame holds the entity's world.
        spec.attach(entity, prefix=f"{name}/", frame=spec.worldbody.add_frame())
    # After all have been attached, so that the numbers are in the joined order.
    add_joined(spec, "default", [default_data(part.mj_model) for part in parts])
    # Warnings of the parts have been given already.
    with caught_warnings():
        _check(load_model(spec), parts)
    return spec


def _keep_masses(spec: mujoco.MjSpec, mj_model: mujoco.MjModel) -> None:
    """Write down the inertias that the compiler's settings make of bodies, which a joined model does not have."""
    compiler = spec.compiler
    if not (
        compiler.settotalmass > 0.0
        or compiler.boundmass
        or compiler.boundinertia
        or compiler.balanceinertia
    ):
        return
    for number, body in enumerate(spec.bodies):
        # Body 0 is the world.
        if number == 0 or mj_model.body_mass[number] == 0.0:
            continue
        body.explicitinertial = True
        # A full inertia, if there is one, would win over the principal one: NaN means none.
        body.fullinertia = [np.nan, 0.0, 0.0, 0.0, 0.0, 0.0]
        body.mass = mj_model.body_mass[number]
        body.inertia = mj_model.body_inertia[number]
        body.ipos = mj_model.body_ipos[number]
        body.iquat = mj_model.body_iquat[number]
    # The settings have done their work in the numbers above.
    compiler.settotalmass = -1.0
    # Explicit inertias would be ignored.
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _check(mj_model: mujoco.MjModel, parts: list[_Part]) -> None:
    """Compare a joined model with its parts, field by field."""
    for kind, count in COUNTS.items():
        rows_of = _rows(mj_model, kind, parts)
        fields = [
            name
            for name in dir(mj_model)
            if name.startswith(f"{kind}_") and not PLACES.fullmatch(name)
        ]
        for part, rows in zip(parts, rows_of, strict=True):
            # An element that is missing or doubled would shift all rows after it.
            own = _own_rows(part.mj_model, kind)
            if len(own) != len(rows):
                raise ValueError(
                    f"scene: {part.name!r} has {len(own)} of {count} alone and {len(rows)} beside the others"
                )
            for field in fields:
                _compare(part, field, own, getattr(mj_model, field)[rows])


def _compare(part: _Part, field: str, own: list[int], joined_values: np.ndarray) -> None:
    """Refuse a field of a part that has other values beside the others."""
    alone = getattr(part.mj_model, field)[own]
    same = np.isclose(alone, joined_values, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True)
    if same.all():
        return
    # The first difference is enough for a message.
    place = int(np.argwhere(~same)[0][0])
    # Users know joints by one name for both kinds of rows.
    if field.startswith(("jnt_", "dof_")):
        kind = "joint"
    else:
        kind = field.split("_")[0]
    raise ValueError(
        f"scene: {field} of {kind} number {own[place]} of {part.name!r} is {alone[place]} alone and "
        f"{joined_values[place]} beside the others: a setting of its file does not reach a joined model; write what it "
        "makes of the element into the file"
    )


def _own_rows(mj_model: mujoco.MjModel, kind: str) -> list[int]:
    """Return the rows of a part's elements; the world's body belongs to all parts."""
    count = getattr(mj_model, COUNTS[kind])
    # The world's body is shared; all others belong to one part.
    return list(range(1 if kind == "body" else 0, count))


def _rows(mj_model: mujoco.MjModel, kind: str, parts: list[_Part]) -> Iterator[list[int]]:
    """Yield the rows of each part's elements in the joined model, in the part's own order."""
    in_world = 0
    elsewhere = 0
    if kind in ("geom", "site"):
        # A model lists elements of the world itself first, of all parts.
        elsewhere = int(np.sum(getattr(mj_model, f"{kind}_bodyid") == 0))
    # Body 0 is the world's own.
    elif kind == "body":
        elsewhere = 1
    for part in parts:
        own = _own_rows(part.mj_model, kind)
        rows: list[int] = []
        for row in own:
            stands_in_world = (
                kind in ("geom", "site") and getattr(part.mj_model, f"{kind}_bodyid")[row] == 0
            )
            if stands_in_world:
                rows.append(in_world)
                in_world += 1
            else:
                rows.append(elsewhere)
                elsewhere += 1
        yield rows
