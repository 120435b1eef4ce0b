"""What holds for each term of the library: it survives YAML, and a config names it by its own module."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any

import pytest
import yaml

from benchmarks.pages import terms
from ksim_rl import mdp
from ksim_rl.envs import from_tree, to_tree

KINDS = tuple(terms.KINDS.values())
SCALARS = {str: "x", float: 0.5, int: 1, bool: True}
# Where one of several optional fields must be given.
ALSO = {
    "OffsetToCommand": {"site": "x"},
    "RootVelocityAbove": {"linear": 0.5},
    "TargetReached": {"site": "x"},
    "TrackPosition": {"site": "x"},
    # These read a running episode, and so have no meaning at resets.
    "Jump": {"mode": "interval", "interval_range_s": (1.0, 2.0)},
    "PushByForce": {"mode": "interval", "interval_range_s": (1.0, 2.0)},
    "PushByVelocity": {"mode": "interval", "interval_range_s": (1.0, 2.0)},
}


def example(annotation: Any) -> Any:
    """A value that the annotation of a required field allows."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return example(arguments[0])
    if origin is typing.Literal:
        return arguments[0]
    if origin is tuple:
        return (0.1, 0.5) if arguments == (float, float) else (example(arguments[0]),)
    if origin is Mapping:
        return {example(arguments[0]): example(arguments[1])}
    return SCALARS[annotation]


def made(name: str) -> Any:
    term = getattr(mdp, name)
    hints = typing.get_type_hints(term)
    required = {
        field.name: example(hints[field.name])
        for field in dataclasses.fields(term)
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }
    return term(**(required | ALSO.get(name, {})))


@pytest.mark.parametrize("name", mdp.__all__)
def test_a_term_survives_yaml(name):
    term = made(name)
    (kind,) = [kind for kind in KINDS if isinstance(term, kind)]
    tree = yaml.safe_load(yaml.safe_dump(to_tree(term, kind)))
    assert from_tree(kind, tree) == term
    with pytest.raises(ValueError, match=r"unknown field 'task\.wieght'"):
        from_tree(kind, tree | {"wieght": 1.0}, "task")


# What terms share.
BASES = """
    BodyObservation EncodedJoints FieldsByStage
    FramedObservation GaussianReward HeldCommand JointAction JointLimitReward JointReset
    LevelCurriculum OfBodies OfSwing Randomize RandomizeActuator RandomizeBodyField RandomizeField RandomizeJointField
    RandomizeModelField RandomizeNumber RandomizePos RandomizeTendonField RandomizeTurn RewardWeight
    RewardWhileCommanded SteeredAction SteppedLevel Symmetry
"""


def test_the_list_is_sorted_and_complete():
    assert mdp.__all__ == sorted(set(mdp.__all__)) == dir(mdp)
    defined = {
        name
        for name, value in vars(mdp).items()
        if isinstance(value, type) and issubclass(value, KINDS) and value not in KINDS
    }
    assert defined == {*mdp.__all__, *BASES.split()}
