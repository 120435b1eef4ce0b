"""No Python of a user is frozen in silence: what a step asks for in Python follows, or is refused by name."""

import ctypes
import types
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from torchrl.envs import RewardScaling, RewardSum

from ksim_rl.collectors.compiled_step import CompiledStep
from ksim_rl.envs.recorded_python import FrozenPythonError
from ksim_rl.envs.term import EventMode, EventTerm
from tests.collectors.recorded_puck import Calling, Constant, collector_of, rewards_of

SCALE = 1.0


# -- what a program changes from outside: it follows ---------------------------------------------------------------


class OfGlobal(Constant):
    def value(self):
        return SCALE


class OfModule(Constant):
    def value(self):
        return settings.scale


class OfClass(Constant):
    factor = 1.0

    def value(self):
        return self.factor


settings = types.ModuleType("tests.settings")
settings.scale = 1.0


@dataclass
class Progress:
    """What a program counts."""

    iteration: int = 1


@dataclass(frozen=True, kw_only=True)
class ByIteration(Constant):
    progress: Progress

    def value(self):
        return self.progress.iteration


@dataclass(frozen=True, kw_only=True)
class OfTable(Constant):
    table: dict = field(hash=False)

    def value(self):
        return self.table["scale"] + float(self.table["array"].sum())


class OfEnv(Constant):
    """Reads what a program has given the env."""

    def __call__(self, view):
        return torch.full((view.num_envs,), float(getattr(view, "difficulty", 1.0)))


def double_attribute(env):
    object.__setattr__(env.cfg.rewards["term"], "scale", 2.0)


def double_global(env):
    globals()["SCALE"] = 2.0


def double_of_module(env):
    settings.scale = 2.0


def double_of_class(env):
    OfClass.factor = 2.0


def double_iteration(env):
    env.cfg.rewards["term"].progress.iteration = 2


def double_entry(env):
    env.cfg.rewards["term"].table["scale"] = 2.0


def double_array(env):
    env.cfg.rewards["term"].table["array"][1] = 1.0


def double_for_view(env):
    env.view.difficulty = 2.0


def double_weight(env):
    env.view.reward_weights["term"].fill_(2.0)


def double_all_weights(env):
    env.reward_manager.weights_R.mul_(2.0)


def append_scaling(env):
    env.append_transform(RewardScaling(0.0, 2.0))


def double_method(env):
    given = env.step_and_maybe_reset

    def doubled(td):
        env_state_E, root_E = given(td)
        env_state_E["next", "reward"].mul_(2.0)
        return env_state_E, root_E

    object.__setattr__(env, "step_and_maybe_reset", doubled)


TABLE = {"scale": 1.0, "array": np.zeros(3)}
FOLLOWED = {
    "an attribute of the term": (lambda: Constant(), double_attribute),
    "a global": (lambda: OfGlobal(), double_global),
    "a module": (lambda: OfModule(), double_of_module),
    "a class": (lambda: OfClass(), double_of_class),
    "a curriculum by iteration": (lambda: ByIteration(progress=Progress()), double_iteration),
    "an entry of a dict": (lambda: OfTable(table=TABLE | {"array": np.zeros(3)}), double_entry),
    "an array of numpy": (lambda: OfTable(table=TABLE | {"array": np.zeros(3)}), double_array),
    "an attribute of the env": (lambda: OfEnv(), double_for_view),
    "a weight in place": (lambda: Constant(), double_weight),
    "all weights in place": (lambda: Constant(), double_all_weights),
    "a transform appended": (lambda: Constant(), append_scaling),
    "a method of the env": (lambda: Constant(), double_method),
}


@pytest.mark.parametrize("kind", FOLLOWED)
def test_what_is_changed_from_outside_follows_in_the_next_rollout(kind, monkeypatch):
    monkeypatch.setitem(globals(), "SCALE", 1.0)
    monkeypatch.setattr(settings, "scale", 1.0)
    monkeypatch.setattr(OfClass, "factor", 1.0)
    make, change = FOLLOWED[kind]
    collector = collector_of(rewards={"term": make()})
    before = rewards_of(collector, 2)
    change(collector.env)
    assert (before, rewards_of(collector, 2)) == ([1.0, 1.0], [2.0, 2.0])


def test_a_new_recording_is_said_with_what_has_changed():
    collector = collector_of(rewards={"term": Constant()})
    rewards_of(collector)
    double_attribute(collector.env)
    with pytest.warns(
        RuntimeWarning, match=r"rewards\.term\.scale was 1\.0 and is 2\.0 since .* recorded again"
    ):
        collector.collect()


def test_transforms_follow_where_they_stand_and_as_they_are():
    collector = collector_of(rewards={"term": Constant()})
    env = collector.env
    means = rewards_of(collector)
    env.append_transform(RewardScaling(0.0, 2.0))
    means += rewards_of(collector)
    env.insert_transform(0, RewardScaling(1.0, 1.0))
    means += rewards_of(collector)
    env.transform[-1].scale.fill_(3.0)
    means += rewards_of(collector)
    env.transform[-1].scale = torch.tensor(4.0)
    means += rewards_of(collector, 4)
    env.transform.pop(0)
    means += rewards_of(collector, 8)[-1:]
    assert means == [1.0, 2.0, 4.0, 6.0, 8.0, 8.0, 8.0, 8.0, 4.0]


def test_a_transform_with_a_memory_begins_with_a_reset():
    collector = collector_of(rewards={"term": Constant()})
    rewards_of(collector, 2)
    collector.env.append_transform(RewardSum())
    with pytest.warns(RuntimeWarning, match="all envs are reset"):
        rollout_ET = collector.collect()
    assert rollout_ET["next", "episode_reward"][0].flatten().tolist() == [1.0, 2.0, 3.0, 4.0]


def test_what_changes_in_each_rollout_runs_in_python_until_it_stays():
    progress = Progress()
    collector = collector_of(rewards={"term": ByIteration(progress=progress)})
    means, is_compiled = [], []
    for iteration in (1, 2, 3, 4, 5, 5, 5, 5):
        progress.iteration = iteration
        means += rewards_of(collector)
        is_compiled.append(collector.compiled_step is not None)
    assert means == [1.0, 2.0, 3.0, 4.0, 5.0, 5.0, 5.0, 5.0]
    assert is_compiled == [True, True, False, False, False, False, True, True]


# -- what has no effect any more: refused --------------------------------------------------------------------------


def change_weight(env):
    object.__setattr__(env.cfg.rewards["term"], "weight", 2.0)


def change_length(env):
    object.__setattr__(env.cfg, "episode_length_s", 1.0)


def add_term(env):
    env.cfg.rewards["other"] = Constant()


def change_iterations(env):
    env.world.warp_model.opt.iterations = 1


WITHOUT_EFFECT = {
    "a weight of the config": (
        change_weight,
        r"rewards\.term\.weight was 1\.0 and is 2\.0, without effect",
    ),
    "a field of the config": (
        change_length,
        r"cfg\.episode_length_s was 0\.0 and is 1\.0, without effect",
    ),
    "a term more": (
        add_term,
        r"cfg\.rewards\['other'\] was \(absent\) and is a Constant, without effect",
    ),
    "an option of the world": (
        change_iterations,
        r"world\.warp_model\.opt\.iterations was \d+ and is 1",
    ),
}


@pytest.mark.parametrize("kind", WITHOUT_EFFECT)
def test_a_change_that_comes_too_late_is_refused_by_name(kind):
    change, message = WITHOUT_EFFECT[kind]
    collector = collector_of(rewards={"term": Constant()})
    rewards_of(collector)
    change(collector.env)
    with pytest.raises(FrozenPythonError, match=message):
        collector.collect()


def test_a_tensor_that_managers_hold_on_to_cannot_be_replaced():
    env = collector_of(rewards={"term": Constant()}).env
    with pytest.raises(TypeError):
        env.view.reward_weights["term"] = torch.tensor(2.0)


# -- what nothing shows but the numbers: found by comparison --------------------------------------------------------
# Of the four rows one ends in a comparison, and has no reward and no step there.


class Hidden:
    """A value that lies where no attribute shows it, as in a library of C."""

    def __init__(self, value):
        self.box = ctypes.c_long(value)

    def __call__(self):
        return self.box.value


@dataclass(frozen=True, kw_only=True)
class Wind(EventTerm):
    """Pushes by what `ask` says."""

    mode: EventMode = "step"
    ask: object = None

    def __call__(self, view, mask_E):
        view.joints().write_vel(mask_E, view.joint_vel_EL + float(self.ask()))


def test_what_nothing_shows_is_found_after_as_many_rollouts_as_there_were_before():
    term = Calling(ask=Hidden(1))
    collector = collector_of(rewards={"calm": Constant(), "term": term})
    made = 3
    rewards_of(collector, made)
    term.ask.box.value = 2
    with pytest.raises(
        FrozenPythonError, match=r"another rewards\.term in 3 rows.* the last 2 rollouts"
    ) as found:
        for _ in range(made + 1):
            made += 1
            collector.collect()
    assert made == 5 and found.value.rollouts == 2


def test_what_an_event_does_otherwise_is_found_by_comparison():
    wind = Wind(ask=Hidden(0))
    collector = collector_of(rewards={"term": Constant()}, events={"wind": wind})
    rewards_of(collector, 2)
    wind.ask.box.value = 1
    with pytest.raises(FrozenPythonError, match="another next.obs.position in 3 rows"):
        collector.collect()


@pytest.mark.full
def test_what_a_reset_does_otherwise_is_found_though_no_row_ends_in_the_rollouts():
    start = Wind(ask=Hidden(0), mode="reset")
    collector = collector_of(rewards={"term": Constant()}, events={"start": start})
    rewards_of(collector, 2)
    start.ask.box.value = 1
    with pytest.raises(FrozenPythonError, match=r"another root\.obs\.velocity in 1 rows"):
        collector.collect()


def test_kernels_that_differ_though_nothing_is_frozen_end_no_run(monkeypatch):
    collector = collector_of(rewards={"term": Constant()})
    before = rewards_of(collector)
    given = CompiledStep.differences
    found = iter([["rewards.term in 1 rows"]])
    # The next comparison alone finds a difference; kernels that are made then agree.
    monkeypatch.setattr(CompiledStep, "differences", lambda self: next(found, None) or given(self))
    with pytest.warns(RuntimeWarning, match=r"NOT COMPILED any more.* another rewards\.term in 1"):
        collector.collect()
    assert collector.compiled_step is None
    assert rewards_of(collector, 3) == before * 3


def test_a_comparison_leaves_rollouts_as_they_are(monkeypatch):
    def rollouts():
        torch.manual_seed(0)
        collector = collector_of(rewards={"term": Constant()}, episode_length_s=0.1)
        return [collector.collect().clone() for _ in range(5)]

    compared = rollouts()
    monkeypatch.setattr("ksim_rl.collectors.recording.Recording._check", lambda *_: None)
    for own, true in zip(compared, rollouts(), strict=True):
        for key in true.keys(True, True):
            assert torch.equal(own[key], true[key]), key
