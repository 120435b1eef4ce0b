"""Slips in terms of one's own: each is named in one line, when the env is built or at the first step."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from torchrl.envs.transforms import Transform

from ksim_rl import envs
from ksim_rl.envs.term import (
    ActionTerm,
    CommandTerm,
    CurriculumTerm,
    EventTerm,
    MetricTerm,
    ObservationTerm,
    RewardTerm,
    TerminationTerm,
)
from ksim_rl.testing import check_env
from ksim_rl.transforms import ObservationTermCfg, TransformCfg

E = 3


@dataclass(frozen=True, kw_only=True)
class Reward(RewardTerm):
    """Returns what a function makes of the view."""

    make: Callable[..., Any]

    def __call__(self, view):
        return self.make(view)


@dataclass(frozen=True, kw_only=True)
class Observation(ObservationTerm):
    make: Callable[..., Any]

    def __call__(self, view):
        return self.make(view)


@dataclass(frozen=True, kw_only=True)
class Termination(TerminationTerm):
    make: Callable[..., Any]

    def __call__(self, view):
        return self.make(view)


@dataclass(frozen=True, kw_only=True)
class Metric(MetricTerm):
    make: Callable[..., Any]

    def __call__(self, view):
        return self.make(view)


@dataclass(frozen=True, kw_only=True)
class Curriculum(CurriculumTerm):
    make: Callable[..., Any]

    def __call__(self, view, mask_E):
        return self.make(view)


@dataclass(frozen=True, kw_only=True)
class Command(CommandTerm):
    make: Callable[..., Any]
    resampling_time_range_s: Any = None

    def resample(self, view, mask_E):
        pass

    def __call__(self, view):
        return self.make(view)


@dataclass(frozen=True, kw_only=True)
class Event(EventTerm):
    make: Callable[..., Any]

    def __call__(self, view, mask_E):
        view.write_qpos(mask_E, self.make(view))


@dataclass(frozen=True, kw_only=True)
class Action(ActionTerm):
    make: Callable[..., Any]
    limits: Any = field(default=None)

    def size(self, view):
        return self.make(view)

    def bounds(self, view):
        return self.limits

    def __call__(self, view, action_EK):
        pass


def nothing(view):
    """Forget to return."""


def pos(view):
    return view.joint_pos_EL


def narrower_later(view):
    """Return two columns where the env is built, and one from the first step on."""
    return pos(view) if int(view.step_count) == 0 else pos(view)[:, :1]


def base(**changes):
    cfg = envs.make_cfg("cartpole_balance", [f"task.scene.num_envs={E}", "task.sim.engine=c"])
    return replace(cfg, **changes)


def observing(make):
    actor = base().observations["actor"]
    terms = {**actor.terms, "mine": ObservationTermCfg(term=Observation(make=make))}
    return base(observations={**base().observations, "actor": replace(actor, terms=terms)})


def adding(kind, term):
    return base(**{kind: {**(getattr(base(), kind) or {}), "mine": term}})


ONE = "one value per env"
ROW = "one row per env"
SLIPS = {
    "reward without return": (
        "rewards",
        Reward,
        nothing,
        f"reward term 'mine' returns NoneType: .* {ONE}",
    ),
    "reward of a float": (
        "rewards",
        Reward,
        lambda v: 1.0,
        f"reward term 'mine' returns float: .* {ONE}",
    ),
    "reward of an array": (
        "rewards",
        Reward,
        lambda v: pos(v)[:, 0].numpy(),
        "reward term 'mine' returns ndarray",
    ),
    "reward by joint": (
        "rewards",
        Reward,
        pos,
        rf"reward term 'mine' returns torch.float32 \(3, 2\): .* {ONE}",
    ),
    "reward with a leaf dim": (
        "rewards",
        Reward,
        lambda v: pos(v)[:, :1],
        r"reward term 'mine' .*\(3, 1\)",
    ),
    "reward of all envs": (
        "rewards",
        Reward,
        lambda v: pos(v).mean(),
        r"reward term 'mine' .* \(\): expected",
    ),
    "termination without return": (
        "terminations",
        Termination,
        nothing,
        "termination term 'mine' returns NoneType",
    ),
    "termination of a bool": (
        "terminations",
        Termination,
        lambda v: False,
        "termination term 'mine' returns bool",
    ),
    "termination of floats": (
        "terminations",
        Termination,
        lambda v: pos(v)[:, 0],
        "'mine' .*expected torch.bool",
    ),
    "metric without return": ("metrics", Metric, nothing, "metric term 'mine' returns NoneType"),
    "metric by joint": (
        "metrics",
        Metric,
        pos,
        r"metric term 'mine' returns torch.float32 \(3, 2\)",
    ),
    "command without return": (
        "commands",
        Command,
        nothing,
        f"command term 'mine' returns NoneType: .* {ROW}",
    ),
    "command of a float": ("commands", Command, lambda v: 1.0, "command term 'mine' returns float"),
    "command without a leaf dim": (
        "commands",
        Command,
        lambda v: pos(v)[:, 0],
        r"'mine' returns shape \(3,\)",
    ),
    "command that is transposed": (
        "commands",
        Command,
        lambda v: pos(v).T,
        r"'mine' returns shape \(2, 3\)",
    ),
    "command that changes": (
        "commands",
        Command,
        narrower_later,
        r"'mine' .* \(3, 1\), and first had \(3, 2\)",
    ),
    "curriculum without return": (
        "curriculum",
        Curriculum,
        nothing,
        "curriculum term 'mine' returns NoneType",
    ),
    "curriculum of a float": (
        "curriculum",
        Curriculum,
        lambda v: 1.0,
        "curriculum term 'mine' returns float",
    ),
    "action without a size": ("actions", Action, nothing, r"actions.mine: size\(\) returns None"),
    "action of a float's size": (
        "actions",
        Action,
        lambda v: 1.0,
        r"actions.mine: size\(\) returns 1.0",
    ),
    "action of no column": (
        "actions",
        Action,
        lambda v: 0,
        "actions.mine: it takes no number of the action",
    ),
    "event of a wrong width": (
        "events",
        Event,
        lambda v: torch.zeros(E, 9),
        r"events.mine: writes values of shape \(3, 9\) into the state: expected \(3, 2\)",
    ),
}
OBSERVATIONS = {
    "no return": (nothing, f"observations.mine: returns NoneType: expected a tensor, {ROW}"),
    "a float": (lambda v: 1.0, "observations.mine: returns float"),
    "transposed": (
        lambda v: pos(v).T,
        rf"'mine' returns torch.float32 \(2, 3\): .*\[3, L\], {ROW}",
    ),
    "no leaf dim": (
        lambda v: pos(v)[:, 0],
        r"observation term 'mine' returns torch.float32 \(3,\)",
    ),
    "float64": (lambda v: pos(v).double(), "observation term 'mine' returns torch.float64"),
    "another width later": (narrower_later, r"'mine' .* \(3, 1\), and first had shape \(3, 2\)"),
}


def use(cfg):
    envs.build(cfg).rollout(2, break_when_any_done=False)


@pytest.mark.parametrize("slip", SLIPS)
def test_a_slip_in_a_term_is_named_in_one_line(slip):
    kind, term, make, message = SLIPS[slip]
    with pytest.raises(ValueError, match=message) as refusal:
        use(adding(kind, term(make=make)))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("slip", OBSERVATIONS)
def test_a_slip_in_an_observation_is_named_in_one_line(slip):
    make, message = OBSERVATIONS[slip]
    with pytest.raises(ValueError, match=message):
        use(observing(make))


def test_bounds_of_another_size_are_named():
    action = Action(make=lambda view: 1, limits=torch.zeros(3, 2))
    with pytest.raises(
        ValueError, match=r"actions.mine: bounds\(\) returns shape \(3, 2\): expected \(1, 2\)"
    ):
        use(adding("actions", action))


class Own(Transform):
    """Makes something of the actor's observation, and says nothing of it."""

    def __init__(self, make):
        super().__init__(in_keys=["actor"], out_keys=["actor"])
        self._make = make

    def _apply_transform(self, obs):
        return self._make(obs)

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)


TRANSFORMS = {
    "wider": (lambda obs: torch.cat((obs, obs), -1), r"is torch.float32 \(3, 10\), and .*\(3, 5\)"),
    "float64": (
        lambda obs: obs.double(),
        r"is torch.float64 \(3, 5\), and .* torch.float32 \(3, 5\)",
    ),
    "no leaf dim": (lambda obs: obs[..., 0], r"is torch.float32 \(3,\), and"),
    "no return": (lambda obs: None, "is NonTensorData, and"),
}
SLOW = ("c_engine", "memory", "syncs", "determinism")


@pytest.mark.parametrize("slip", TRANSFORMS)
def test_a_transform_of_a_wrong_shape_is_named(slip):
    make, message = TRANSFORMS[slip]
    env = envs.build(base())
    env.append_transform(Own(make))
    with pytest.raises(
        AssertionError,
        match=rf"\[values\] observation 'actor', written by transform 1, Own, {message}",
    ):
        check_env(env, skip=SLOW)


def test_check_env_names_the_transform_of_what_is_not_a_number():
    env = envs.build(base())
    env.append_transform(Own(lambda obs: obs * torch.nan))
    with pytest.raises(
        AssertionError, match=r"\[values\] observation 'actor' is not finite .* by transform 1, Own"
    ):
        check_env(env, skip=SLOW)


class Doubling(Own):
    """Gives twice as many numbers as its spec says."""

    def __init__(self):
        super().__init__(lambda obs: torch.cat((obs, obs), -1))


class Halving(Own):
    """Is as it says."""

    def __init__(self):
        super().__init__(lambda obs: 0.5 * obs)


def test_a_tasks_own_transform_of_a_wrong_shape_is_refused_by_name():
    with pytest.raises(
        ValueError,
        match=r"task.transforms.mine: observation 'actor' is torch.float32 \(3, 10\), and",
    ):
        envs.build(base(transforms={"mine": TransformCfg(Doubling)}))


def test_a_tasks_own_transform_that_fits_changes_no_draw():
    plain, halved = (
        envs.build(base(transforms=own, seed=5)) for own in ({}, {"mine": TransformCfg(Halving)})
    )
    expected = plain.reset()["actor"] * 0.5
    assert halved.reset()["actor"].equal(expected)


@pytest.mark.parametrize(("kind", "term"), [("rewards", Reward), ("metrics", Metric)])
def test_check_env_names_what_is_not_a_number_and_nothing_else(kind, term):
    env = envs.build(adding(kind, term(make=lambda view: pos(view)[:, 0] * torch.nan)))
    name = "reward" if kind == "rewards" else "metric"
    with pytest.raises(
        AssertionError, match=rf"has 1 findings:\n\[values\] {name} 'mine' is not finite"
    ):
        check_env(env, skip=SLOW)
