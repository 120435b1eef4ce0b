"""Finds the left-right symmetry of a robot in its names and joint axes."""

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from tensordict import NestedKey

from ksim_rl import checks
from ksim_rl.transforms.groups.groups import GroupSpec, last_name
from ksim_rl.transforms.mirror.mirror import MirrorMap, concatenate

if TYPE_CHECKING:
    import mujoco

_SIDES = {"left": "right", "l": "r", "fl": "fr", "rl": "rr", "hl": "hr", "bl": "br", "ml": "mr"}
_SIDES |= {"lf": "rf", "lh": "rh", "lr": "rr", "lb": "rb", "lm": "rm"}
# Between the words of a name: anything that is no letter, and the humps of CamelCase.
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^A-Za-z]+")
_ARM = re.compile(r"[A-Z][LR]")
_TOLERANCE = 1e-3


def mirror_name(name: str, names: Sequence[str]) -> str:
    """Return which of `names` is the mirror image of `name`; itself if the name has no side.

    Sides are words of a name: left and right, l and r, and FL, FR, RL, RR, LF, RH and the like, in any case; and two
    capitals of which the second is L or R, where that gives another of `names`. Raises ValueError where a name has a
    side and `names` has no counterpart, or more than one.
    """
    # Words that are no side stand for themselves; a side may have several counterparts.
    words = _WORDS.findall(name)
    images = [
        "".join(image)
        for image in itertools.product(*[_counterparts(word) or [word] for word in words])
    ]
    if images == [name]:
        # AL1 and AR1 are arms, but an AR tag has no counterpart.
        arms = "".join(
            word[0] + "LR"["RL".index(word[1])] if _ARM.fullmatch(word) else word for word in words
        )
        if arms in names:
            return arms
        return name
    found = [image for image in images if image in names]
    if len(found) != 1:
        if found:
            hint = f"both {found}"
        else:
            hint = f"none of {images}: {checks.near(images[0], names)}"
        raise ValueError(f"mirror image of {name!r}: {hint}")
    return found[0]


def _counterparts(word: str) -> list[str]:
    swapped = [b for a, b in _SIDES.items() if a == word.lower()]
    swapped += [a for a, b in _SIDES.items() if b == word.lower()]
    # The counterpart is written in the same case.
    if word.isupper():
        return [other.upper() for other in swapped]
    if word[0].isupper():
        return [other.capitalize() for other in swapped]
    return swapped


def mirror_by_name(names: Sequence[str], each: MirrorMap | None = None) -> MirrorMap:
    """Return the map of a vector that has one number per name, or one block per name that `each` mirrors.

    Example:
        >>> mirror_by_name(["FL", "FR"], POLAR)  # two forces, one after another
    """
    if each is None:
        each = MirrorMap(source=(0,))
    # Block i of the image is the block of the counterpart of name i.
    blocks = [list(names).index(mirror_name(name, names)) for name in names]
    return MirrorMap(
        source=tuple(block * each.size + column for block in blocks for column in each.source),
        signs=each.signs * len(names),
    )


def mirror_joints(mj_model: "mujoco.MjModel", joints: Sequence[str] | None = None) -> MirrorMap:
    """Return the map of a vector with one number per joint: position, velocity, effort, target, action.

    The mirror is the plane y = 0 of the world, with the robot at `qpos0`. A hinge's sign is 1 if its counterpart
    turns the mirrored way about its own axis, else -1; a slide's likewise. Positions have to be absolute or relative to
    a pose that is its own mirror image. `joints` are hinges and slides in the order of the columns, None for all.
    Raises ValueError where a joint has no counterpart, or the two are no mirror images of each other.
    """
    # A caller with a model has MuJoCo; the other transforms need none.
    import mujoco

    data = mujoco.MjData(mj_model)
    # Axes and anchors are compared in the world frame, at the pose that the model is drawn in.
    data.qpos[:] = mj_model.qpos0
    mujoco.mj_kinematics(mj_model, data)
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    scalar = (hinge, int(mujoco.mjtJoint.mjJNT_SLIDE))
    valid = {
        mj_model.joint(i).name: i for i in range(mj_model.njnt) if mj_model.jnt_type[i] in scalar
    }
    if joints is None:
        names = list(valid)
    else:
        names = list(joints)
    for name in names:
        checks.check_known("hinge or slide", name, valid)
    source = []
    signs = []
    for name in names:
        other = mirror_name(name, names)
        source.append(names.index(other))
        signs.append(_sign(mj_model, data, valid[name], valid[other], hinge=hinge))
    return MirrorMap(source=tuple(source), signs=tuple(signs))


def _sign(
    mj_model: "mujoco.MjModel", data: "mujoco.MjData", joint: int, other: int, *, hinge: int
) -> float:
    reflection = np.array([1.0, -1.0, 1.0])
    apart = np.abs(data.xanchor[joint] * reflection - data.xanchor[other]).max()
    # A rotation axis is a pseudovector: its mirror image turns the other way as well.
    if mj_model.jnt_type[joint] == hinge:
        handed = -1.0
    else:
        handed = 1.0
    agreement = float(handed * reflection * data.xaxis[joint] @ data.xaxis[other])
    # Anchors may differ by 2 percent of the robot's size, and axes by a thousandth.
    extent = max(float(mj_model.stat.extent), _TOLERANCE)
    differs = (
        mj_model.jnt_type[joint] != mj_model.jnt_type[other] or abs(abs(agreement) - 1) > _TOLERANCE
    )
    if differs or apart > 0.02 * extent:
        raise ValueError(
            f"joints {mj_model.joint(joint).name!r} and {mj_model.joint(other).name!r} are no mirror images of each "
            f"other in the plane y = 0: axes {data.xaxis[joint]} and {data.xaxis[other]}, anchors {apart:.3g} m apart"
        )
    if agreement > 0:
        return 1.0
    return -1.0


def mirror_group(group: GroupSpec, terms: Mapping[NestedKey, MirrorMap]) -> MirrorMap:
    """Return the map of a group vector from the maps of its terms, by key of the term or by the last part of it.

    A flat history repeats its term's. Raises ValueError where a term has no map, or one whose size does not divide it.
    """
    maps = []
    for key, size in zip(group.terms, group.sizes, strict=True):
        mirror = terms.get(key, terms.get(last_name(key)))
        if mirror is None:
            raise checks.unknown_name(
                f"mirror map for a term of group {group.name!r}:", last_name(key), map(str, terms)
            )
        if size % mirror.size:
            raise ValueError(
                f"term {key!r} has {size} columns, and its mirror map {mirror.size}: expected a multiple"
            )
        # A flat history is as many copies of the term as it has frames.
        maps += [mirror] * (size // mirror.size)
    return concatenate(maps)
