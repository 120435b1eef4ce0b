"""No Python of a user is frozen in silence: what a step asks for in Python follows, or is refused by name."""

import ctypes
import itertools
import os
import random
import time
import types
import warnings
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.envs import RewardScaling, RewardSum

from ksim_rl import envs
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.envs.recorded_python import FrozenPythonError
from ksim_rl.envs.term import EventTerm, RewardTerm
from tests.envs.probe_env import puck_cfg

ROWS, STEPS = 4, 4
CALLS = 0
SCALE = 1.0
SEEN: list[int] = []


def policy(td):
    return td.set("action", torch.zeros(*td.batch_size, 1))


def collector_of(*, rewards, eager=False, **fields):
    """Return a collector for the puck, whose reward is the sum of the terms."""
    cfg = puck_cfg(num_envs=ROWS, rewards=rewards, scale_rewards_by_dt=False, limit=None, **fields)
    env = envs.build(cfg)
    return RolloutCollector(env, policy, rollout_length=STEPS, cfg=CollectorCfg(eager=eager))


def rewards_of(collector, count=1):
    """Return the mean rewards of the next rollouts, without saying that something is recorded anew."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return [float(collector.collect()["next", "reward"].mean()) for _ in range(count)]


@dataclass(frozen=True, kw_only=True)
class Constant(RewardTerm):
    """The same in all rows: `value()`."""

    scale: float = 1.0

    def value(self):
        return self.scale

    def __call__(self, view):
        return torch.full((view.num_envs,), float(self.value()), device=view.device)


# -- Python that a call changes, and Python that asks the host: refused --------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Counter(Constant):
    calls: int = 0

    def value(self):
        object.__setattr__(self, "calls", self.calls + 1)
        return self.calls > 20


@dataclass(kw_only=True, unsafe_hash=True, frozen=True)
class OwnList(Constant):
    seen: list = field(default_factory=list, hash=False)

    def value(self):
        self.seen.append(1)
        return len(self.seen)


class OwnClassAttribute(Constant):
    count = 0

    def value(self):
        type(self).count += 1
        return self.count


class GlobalCounter(Constant):
    def value(self):
        global CALLS
        CALLS += 1
        return CALLS


class GlobalList(Constant):
    def value(self):
        SEEN.append(1)
        return len(SEEN)


def counting():
    count = 0

    def count_on():
        nonlocal count
        count += 1
        return count

    return count_on


@dataclass(frozen=True, kw_only=True)
class Calling(Constant):
    """Asks what it was given."""

    ask: object = None

    def value(self):
        return self.ask()


class MutableDefault(Constant):
    def value(self, memory=[]):  # noqa: B006
        memory.append(1)
        return len(memory)


class OfView(Constant):
    """Keeps its count where other terms may look for it."""

    def __call__(self, view):
        view.count = getattr(view, "count", 0) + 1
        return torch.full((view.num_envs,), float(view.count))


class WallClock(Constant):
    def value(self):
        return time.time() % 100.0


class Today(Constant):
    def value(self):
        return datetime.now().second


class PythonRandom(Constant):
    def value(self):
        return random.uniform(0.0, 1.0)


class NumpyRandom(Constant):
    def value(self):
        return np.random.rand()


class Environment(Constant):
    def value(self):
        return float(os.environ.get("PUCK_SCALE", "1"))


@dataclass(frozen=True, kw_only=True)
class FromFile(Constant):
    path: Path = Path()

    def value(self):
        return float(self.path.read_text())


def one_after_the_other():
    yield from range(10_000)


REFUSED = {
    "a counter of the term": (lambda: Counter(), r"rewards\.term\.calls was \d+ and is \d+"),
    "a list of the term": (lambda: OwnList(), r"rewards\.term\.seen\[\d+\] was \(absent\) and is 1"),
    "a counter of its class": (lambda: OwnClassAttribute(), r"rewards\.term: OwnClassAttribute\.count was"),
    "a global counter": (lambda: GlobalCounter(), r"rewards\.term: .*global .*CALLS was"),
    "a global list": (lambda: GlobalList(), r"rewards\.term: .*global .*SEEN\[\d+\] was"),
    "a closure": (lambda: Calling(ask=counting()), r"rewards\.term\.ask: count in the closure of"),
    "a generator": (lambda: Calling(ask=one_after_the_other().__next__), r"rewards\.term\.ask"),
    "an iterator": (lambda: Calling(ask=itertools.count().__next__), r"rewards\.term\.ask\.place was"),
    "a default argument": (lambda: MutableDefault(), r"rewards\.term: .*defaults of .*value"),
    "an attribute of the view": (lambda: OfView(), r"view\.count was \d+ and is \d+"),
    "a wall clock": (lambda: WallClock(), r"rewards\.term asks for a clock, by time\.time at test_recording"),
    "a date": (lambda: Today(), r"rewards\.term asks for a clock, by datetime\.now"),
    "random": (lambda: PythonRandom(), r"rewards\.term asks for random numbers .*, by Random\.random"),
    "numpy.random": (lambda: NumpyRandom(), r"rewards\.term asks for random numbers .*, by numpy\.random"),
    "a generator of numpy": (
        lambda: Calling(ask=np.random.default_rng(0).random),
        r"rewards\.term\.ask\.state is another object|rewards\.term\.ask\.state was",
    ),
    "a generator of random": (lambda: Calling(ask=random.Random(0).random), r"rewards\.term"),
    "the environment": (lambda: Environment(), r"rewards\.term asks for an environment variable"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_python_that_changes_from_step_to_step_is_refused_by_name(kind):
    make, message = REFUSED[kind]
    collector = collector_of(rewards={"term": make()})
    with pytest.raises(FrozenPythonError, match=message) as refusal:
        collector.collect()
    assert "collector.eager=true" in str(refusal.value)


def test_a_file_that_a_term_reads_is_refused_by_name(tmp_path):
    path = tmp_path / "scale"
    path.write_text("2.0")
    with pytest.raises(FrozenPythonError, match=r"rewards\.term asks for a file, by io\.open"):
        collector_of(rewards={"term": FromFile(path=path)}).collect()


@pytest.mark.parametrize("kind", ["a counter of the term", "a closure", "random", "a wall clock"])
def test_with_eager_the_python_of_each_step_runs(kind):
    make, _ = REFUSED[kind]
    collector = collector_of(rewards={"term": make()}, eager=True)
    means = rewards_of(collector, 8)
    assert len(set(means)) > 1


# -- what somebody changes from outside: it follows ----------------------------------------------------------------


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
        RuntimeWarning, match=r"rewards\.term\.scale was 1\.0 and is 2\.0 since .* recorded anew"
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
    "a weight of the config": (change_weight, r"rewards\.term\.weight was 1\.0 and is 2\.0, without effect"),
    "a field of the config": (change_length, r"cfg\.episode_length_s was 0\.0 and is 1\.0, without effect"),
    "a term more": (add_term, r"cfg\.rewards\['other'\] was \(absent\) and is a Constant, without effect"),
    "an option of the world": (change_iterations, r"world\.warp_model\.opt\.iterations was \d+ and is 1"),
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


class Hidden:
    """A value that lies where no attribute shows it, as in a library of C."""

    def __init__(self, value):
        self.box = ctypes.c_long(value)

    def __call__(self):
        return self.box.value


@dataclass(frozen=True, kw_only=True)
class Wind(EventTerm, mode="step"):
    """Pushes by what `ask` says."""

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
        FrozenPythonError, match=r"another rewards\.term in 4 rows.* the last 2 rollouts"
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
    with pytest.raises(FrozenPythonError, match="another next.obs.position in 4 rows"):
        collector.collect()


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
