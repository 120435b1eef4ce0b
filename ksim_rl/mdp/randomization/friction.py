"""These events draw the friction of geoms and of contact pairs, and say where a contact would not feel it."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.randomization.randomize import RandomizeModelField
from ksim_rl.scene.names import Patterns

_KINDS = ("sliding", "torsional", "rolling")
# From which number of dimensions on a contact feels each kind.
_DIMENSIONS = (3, 4, 6)
# A pair has two tangents for sliding and two for rolling.
_KIND_OF_PAIR_COLUMN = (0, 0, 1, 2, 2)


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomFriction(RandomizeModelField):
    """Friction of geoms; columns: 0 sliding, 1 torsional (m), 2 rolling (m). One pair for all is for sliding.

    In a contact the geom of higher `priority` says it, and of equal ones that with the larger number, for each column:
    values below the ground's friction do nothing unless the geom's priority is higher.
    """

    field = "geom_friction"
    columns = 3
    lowest = 0.0
    columns_of_one_pair = (0,)
    geoms: Patterns

    def unfelt_columns(self, view: EnvView) -> Sequence[str]:
        model = view.world.mj_model
        rows = self.ids(view)
        lines: list[str] = []
        for column, pair in self.ranges_by_column().items():
            own_N = self.nominal(view)[:, column]
            # Ends of the range for each geom, from its own value.
            low_N, high_N = self.reach(own_N, pair)
            # Geoms with the same reason share a line of the report.
            found: dict[str, list[str]] = {}
            for geom, low, high in zip(rows, low_N, high_N, strict=True):
                reason = _unfelt(model, geom, column, (float(low), float(high)))
                if reason:
                    found.setdefault(reason, []).append(model.geom(geom).name or f"number {geom}")
            for reason, names in found.items():
                lines.append(f"{_KINDS[column]} friction of geoms {', '.join(names)} {reason}")
        return lines


@dataclass(frozen=True, kw_only=True)
class RandomizePairFriction(RandomizeModelField):
    """Friction of contact pairs (`<pair name=...>`); columns: 0, 1 sliding, 2 torsional (m), 3, 4 rolling (m).

    One pair of numbers for all columns is for both of sliding.
    """

    field = "pair_friction"
    columns = 5
    lowest = 0.0
    columns_of_one_pair = (0, 1)
    pairs: Patterns

    def unfelt_columns(self, view: EnvView) -> Sequence[str]:
        model = view.world.mj_model
        lines: list[str] = []
        for column in self.ranges_by_column():
            kind = _KIND_OF_PAIR_COLUMN[column]
            dull = [pair for pair in self.ids(view) if model.pair_dim[pair] < _DIMENSIONS[kind]]
            if dull:
                names = ", ".join(model.pair(pair).name for pair in dull)
                lines.append(f"{_KINDS[kind]} friction of pairs {names} {_needs(kind)}")
        return lines


def _needs(kind: int) -> str:
    return f"has no effect: their contacts have less than {_DIMENSIONS[kind]} dimensions (condim)"


def _unfelt(mj_model: mujoco.MjModel, geom: int, column: int, reach: tuple[float, float]) -> str:
    """Return why fixed geoms feel none of the values drawn for a geom, or only the upper part; empty if all is felt."""
    # Bodies welded to the world: the ground, and what is fixed to it.
    fixed = np.flatnonzero(mj_model.body_weldid[mj_model.geom_bodyid] == 0)
    grounds = [
        int(other) for other in fixed if other != geom and _collide(mj_model, geom, int(other))
    ]
    # The lowest friction among the grounds of equal priority: from there on draws are felt.
    floor = np.inf
    felt_from = ""
    for ground in grounds:
        name = mj_model.geom(ground).name or f"number {ground}"
        own = int(mj_model.geom_priority[geom])
        other = int(mj_model.geom_priority[ground])
        # MuJoCo's rule: the geom of higher priority decides alone, equal ones by the larger value.
        if own > other:
            condim = int(mj_model.geom_condim[geom])
        elif own < other:
            return f"has no effect on {name!r}, whose priority is higher: give these geoms a higher one"
        else:
            condim = int(mj_model.geom_condim[[geom, ground]].max())
        if condim < _DIMENSIONS[column]:
            return _needs(column)
        # Own priority is higher: every draw is felt.
        if own > other:
            return ""
        friction = float(mj_model.geom_friction[ground, column])
        if friction < floor:
            floor = friction
            felt_from = name
    # Even the lowest draw is above the ground's friction.
    if not grounds or reach[0] >= floor:
        return ""
    if reach[1] <= floor:
        where = "has no effect"
    else:
        where = f"has no effect below {floor:g}"
    return f"{where}, the friction of {felt_from!r} at the same priority: give these geoms a higher one"


def _collide(mj_model: mujoco.MjModel, geom: int, other: int) -> bool:
    """Whether two geoms may touch by their bits; explicit pairs have friction of their own."""
    # MuJoCo lets two geoms collide if either one's type meets the other's affinity.
    types = mj_model.geom_contype
    affinities = mj_model.geom_conaffinity
    return bool(types[geom] & affinities[other]) or bool(types[other] & affinities[geom])
