"""Resolves names of a model's elements, once, to index tensors or slices."""

import re
from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from ksim_rl.checks import naming, near

Patterns = str | Sequence[str]
Index = Int64[Tensor, " N"] | slice
SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
TO_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
"""The transmissions of actuators that drive joints."""


class NameResolver:
    """Looks up names and regular expressions (full match) among the elements of one model.

    Each pattern's matches come in the model's order; patterns keep the order in which they are given. So `".*"` gives
    the model's order, and a tuple of plain names gives its own. Results are remembered: a look-up in a step costs one
    dict access, and the index is a slice wherever the ids are contiguous. A ValueError if a pattern matches nothing
    (with the near names), or two patterns match the same element.
    """

    def __init__(self, mj_model: mujoco.MjModel, device: torch.device) -> None:
        self._device = device
        m = mj_model
        counts = {
            "body": m.nbody,
            "geom": m.ngeom,
            "site": m.nsite,
            "actuator": m.nu,
            "sensor": m.nsensor,
        }
        counts |= {"tendon": m.ntendon, "pair": m.npair, "camera": m.ncam, "light": m.nlight}
        counts["material"] = m.nmat
        # Rows of each table; joints are hinges and slides only, as actions and observations know them.
        ids: dict[str, Sequence[int]] = {kind: range(count) for kind, count in counts.items()}
        ids["joint"] = scalar_joint_ids(m)
        self._tables = {}
        for kind, own in ids.items():
            # Model accessors are named as the kinds are.
            element = getattr(m, kind)
            self._tables[kind] = [element(i).name for i in own]
        self._ids: dict[tuple[str, tuple[str, ...]], tuple[int, ...]] = {}
        self._indices: dict[tuple[str, tuple[str, ...]], Index] = {}

    def names(self, kind: str) -> list[str]:
        """Return all names of a kind, in the model's order; joints are the hinges and slides."""
        return list(self._tables[kind])

    def ids(self, kind: str, patterns: Patterns) -> tuple[int, ...]:
        """Return the ids that the patterns match; a joint's id counts hinges and slides only."""
        # Look-ups repeat in each step.
        key = (kind, as_patterns(patterns))
        if key not in self._ids:
            self._ids[key] = match_names(kind, key[1], self._tables[kind])
        return self._ids[key]

    def one(self, kind: str, pattern: str) -> int:
        """Return the id of the one element that `pattern` matches; a ValueError if it matches several."""
        # `ids` has found one at least, or refused.
        first, *more = self.ids(kind, pattern)
        if more:
            names = [self._tables[kind][i] for i in (first, *more)]
            raise ValueError(f"{kind} pattern {pattern!r} matches {names}: name one of them")
        return first

    def index(self, kind: str, patterns: Patterns) -> Index:
        """Return the ids as a slice if they are contiguous, else as an int64 tensor on the device."""
        key = (kind, as_patterns(patterns))
        if key not in self._indices:
            self._indices[key] = as_index(self.ids(kind, patterns), self._device)
        return self._indices[key]


def as_patterns(patterns: Patterns) -> tuple[str, ...]:
    """Return one pattern or several as a tuple."""
    if isinstance(patterns, str):
        return (patterns,)
    return tuple(patterns)


def scalar_joint_ids(mj_model: mujoco.MjModel) -> list[int]:
    """Return the ids of the joints with one degree of freedom: hinges and slides."""
    # The model's order.
    return [int(i) for i in np.flatnonzero(np.isin(mj_model.jnt_type, SCALAR_JOINTS))]


def actuators_of_joint(mj_model: mujoco.MjModel, joint: int) -> list[int]:
    """Return the ids of the actuators that drive a joint."""
    # `trnid` means a joint only for these transmissions.
    on_joints = np.isin(mj_model.actuator_trntype, TO_JOINTS)
    return [int(a) for a in np.flatnonzero(on_joints & (mj_model.actuator_trnid[:, 0] == joint))]


def drives_scalar_joint(mj_model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator drives a hinge or a slide."""
    # `trnid` of other transmissions is no joint.
    if int(mj_model.actuator_trntype[actuator]) not in TO_JOINTS:
        return False
    return int(mj_model.jnt_type[mj_model.actuator_trnid[actuator, 0]]) in SCALAR_JOINTS


def as_index(ids: Sequence[int], device: torch.device) -> Index:
    """Return a slice for contiguous increasing ids (no copy when indexing), else an int64 tensor."""
    ids = [int(i) for i in ids]
    # An empty list is no slice: it has no start.
    if ids and ids == list(range(ids[0], ids[0] + len(ids))):
        return slice(ids[0], ids[0] + len(ids))
    return torch.tensor(ids, device=device, dtype=torch.int64)


def match_names(kind: str, patterns: Sequence[str], table: Sequence[str]) -> tuple[int, ...]:
    """Return the places in `table` that the patterns match in full: each pattern's matches in the table's order."""
    found: list[int] = []
    for pattern in patterns:
        with naming(f"{kind} pattern {pattern!r} is no regular expression", re.error):
            expression = re.compile(pattern)
        # Elements without a name cannot be asked for.
        matches = [i for i, name in enumerate(table) if name and expression.fullmatch(name)]
        if not matches:
            raise ValueError(
                f"no {kind} matches {pattern!r}: {near(pattern, [name for name in table if name])}"
            )
        # Twice the same column would be written in an unclear order.
        doubled = [table[i] for i in matches if i in found]
        if doubled:
            raise ValueError(
                f"{kind} {doubled[0]!r} is matched by two of the patterns {patterns}: give it once"
            )
        found.extend(matches)
    return tuple(found)
