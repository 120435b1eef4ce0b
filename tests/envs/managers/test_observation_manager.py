"""Readings: one per term, clean, and of the shape that specs need."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from ksim_rl.envs import EnvView, ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.mdp import JointPos, RandomizeBodyMass
from tests.envs.probe_env import puck_cfg, puck_env_in_c, push


@dataclass(frozen=True, kw_only=True)
class Returns(ObservationTerm):
    """Returns a tensor of some shape and dtype."""

    shape: tuple[int, ...]
    dtype: torch.dtype = torch.float32

    def __call__(self, view: EnvView) -> Tensor:
        return torch.zeros(self.shape, dtype=self.dtype)


@dataclass(frozen=True, kw_only=True)
class Counted(ObservationTerm):
    """A constant, and a count of how often it was asked."""

    calls: ClassVar[list[int]] = []

    def __call__(self, view: EnvView) -> Tensor:
        self.calls.append(1)
        return torch.ones(view.num_envs, 2)


@dataclass(frozen=True, kw_only=True)
class Raw(ObservationTerm):
    """The physics' own memory, not a copy."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.world.qpos_EL


def observing(**groups):
    cfgs = {
        group: ObservationGroupCfg(
            terms={name: ObservationTermCfg(term=term) for name, term in terms.items()}
        )
        for group, terms in groups.items()
    }
    return {"observations": cfgs}


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (Returns(shape=(3,)), r"\(3,\): expected torch\.float32 \[3, L\]"),
        (Returns(shape=(2, 4)), r"\(2, 4\)"),
        (Returns(shape=(3, 4, 1)), r"\(3, 4, 1\)"),
        (Returns(shape=(3, 1), dtype=torch.bool), r"torch\.bool \(3, 1\)"),
        (Returns(shape=(3, 1), dtype=torch.float64), r"torch\.float64 \(3, 1\)"),
    ],
)
def test_a_wrong_shape_or_dtype_is_refused_at_construction(term, message):
    with pytest.raises(ValueError, match="observation term 'odd' returns .*" + message):
        puck_env_in_c(**observing(actor={"odd": term}))


def test_groups_share_a_term_that_is_read_once_a_step():
    env = puck_env_in_c(**observing(actor={"shared": Counted()}, critic={"shared": Counted()}))
    root_E = env.reset()
    Counted.calls.clear()
    push(env, root_E)
    assert len(Counted.calls) == 1
    assert set(root_E["obs"].keys()) == {"shared"}


def test_a_reading_is_no_window_onto_the_physics():
    env = puck_env_in_c(limit=None, **observing(actor={"raw": Raw(), "position": JointPos()}))
    next_E = push(env, env.reset())["next"]
    kept = {name: next_E["obs", name].clone() for name in ("raw", "position")}
    push(env, next_E.clone())
    for name, value in kept.items():
        assert torch.equal(next_E["obs", name], value), name


@dataclass(frozen=True, kw_only=True)
class Window(ObservationTerm):
    """What others read too, and not a copy."""

    onto: str

    def __call__(self, view: EnvView) -> Tensor:
        if self.onto == "state":
            return view.joint_pos_EL
        if self.onto == "quantity":
            return view.joint_pos_rel_EL
        if self.onto == "field":
            return view.field("body_mass")
        if self.onto == "table":
            return view.default_joint_pos_EL
        return view.buffer("kept_E1", 1)


@pytest.mark.parametrize("onto", ["state", "quantity", "field", "table", "buffer"])
@pytest.mark.parametrize("others", [0, 1])
def test_what_is_done_to_a_reading_in_place_reaches_nobody_else(onto, others):
    """A transform of a user's may well work in place."""
    terms = {"window": Window(onto=onto)} | ({"position": JointPos()} if others else {})
    heavier = {"mass": RandomizeBodyMass(bodies="puck", ranges=(1.0, 1.0), mode="reset")}
    env = puck_env_in_c(events=heavier, **observing(actor=terms))
    next_E = push(env, env.reset())["next"]
    check_nobody_else_sees(env, next_E, has_others=bool(others))
    root_E = env.maybe_reset(next_E.exclude("reward"))
    check_nobody_else_sees(env, root_E, has_others=bool(others))


def check_nobody_else_sees(env, td, *, has_others):
    before, quantity = env.state_dict(), env.view.joint_pos_rel_EL.clone()
    position = td["obs", "position"].clone() if has_others else None
    td["obs", "window"].add_(1.0)
    for name, value in env.state_dict().items():
        assert not isinstance(value, Tensor) or torch.equal(value, before[name]), name
    assert torch.equal(env.view.joint_pos_rel_EL, quantity)
    assert position is None or torch.equal(td["obs", "position"], position)


def test_one_name_cannot_mean_two_terms():
    fields = observing(actor={"x": JointPos()}, critic={"x": Raw()})
    with pytest.raises(
        ValueError, match=r"observations\.critic\.terms\.x: another group has a different term"
    ):
        puck_cfg(**fields)


def test_specs_have_the_terms_shapes():
    env = puck_env_in_c(**observing(actor={"two": Counted()}, critic={"one": JointPos()}))
    assert env.observation_spec["obs", "two"].shape == (3, 2)
    assert env.observation_spec["obs", "one"].shape == (3, 1)
