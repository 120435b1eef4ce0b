"""Python that a recording would freeze is refused after two steps; later changes are reported, or refused by name."""

import time
from dataclasses import dataclass, field

import pytest
import torch

from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.envs.python_parts import python_parts
from ksim_rl.envs.recorded_python import FollowedGraph, FrozenPythonError, RecordedPython
from ksim_rl.envs.term import MetricTerm, RewardTerm
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ObservationScale
from tests.envs.probe_env import puck_env


@dataclass(frozen=True, kw_only=True)
class Remembering(RewardTerm):
    """Adds to `seen` at each call from the `first` on."""

    first: int = 0
    seen: list = field(default_factory=list)
    calls: torch.Tensor = field(default_factory=lambda: torch.zeros(()))

    def __call__(self, view):
        self.calls.add_(1)
        if self.calls > self.first:
            self.seen.append(1)
        return torch.zeros(view.num_envs)


def stepping(env):
    root_E = env.reset()

    def step():
        env.step_and_maybe_reset(env.rand_action(root_E.copy()))

    return step


def known(env, others=None):
    """Return the Python of an env after its first steps."""
    python, step = RecordedPython(env, others), stepping(env)
    while not python.is_known:
        with python.calling():
            step()
    return python


def changes(python):
    return [str(change) for change in python.changes()]


def test_what_the_first_step_fills_is_a_cache():
    term = Remembering(first=100)
    env = puck_env(rewards={"remembering": term})
    python, step = RecordedPython(env), stepping(env)
    with python.calling():
        step()
        term.seen.append(1)
    assert not python.is_known
    with python.calling():
        step()
    assert python.is_known and python.changes() == []


def test_what_the_second_step_changes_is_refused():
    env = puck_env(rewards={"remembering": Remembering()})
    with pytest.raises(
        FrozenPythonError, match=r"rewards\.remembering\.seen\[\d\] was \(absent\) and is 1"
    ):
        known(env)


class Keeping(CounterEnv):
    """Keeps a tensor of each step, in the place of the last one."""

    def _step(self, tensordict):
        self.kept = tensordict["action"] + 1.0
        return super()._step(tensordict)


def test_a_tensor_in_the_place_of_another_is_left_to_a_comparison_or_refused():
    with pytest.raises(FrozenPythonError, match=r"Keeping\.kept is another object"):
        known(Keeping())
    env = Keeping()
    python, step = RecordedPython(env, is_compared=True), stepping(env)
    for _ in range(4):
        with python.calling():
            step()
        assert not python.is_known or python.changes() == []
    env.kept = None
    assert changes(python) == []
    env.other = None
    assert changes(python) == ["Keeping.other was (absent) and is None"]


def test_after_forgetting_two_steps_are_looked_at_again():
    python = known(puck_env())
    python.forget()
    assert not python.is_known


def test_what_others_do_counts_as_well():
    def policy():
        return policy.scale

    policy.scale = 1.0
    python = known(puck_env(), {"policy": policy})
    policy.scale = 2.0
    assert changes(python) == [f"policy: {policy.__qualname__}.scale was 1.0 and is 2.0"]


def test_a_policy_that_asks_for_the_time_is_refused():
    env = puck_env()
    python, step = RecordedPython(env, {"policy": time.time}), stepping(env)
    with pytest.raises(
        FrozenPythonError, match=r"asks for a clock, by time\.time at test_recorded_python"
    ):
        while not python.is_known:
            with python.calling():
                step()
                time.time()


def test_steps_resets_seeds_and_states_change_no_python():
    env = MaskedTransformedEnv(
        puck_env(episode_length_s=0.1), ObservationScale([("obs", "position")], scale=2.0)
    )
    python, step = known(env), stepping(env)
    for _ in range(8):
        step()
    env.set_seed(5)
    env.reset(env_ids=[0])
    env.load_state_dict(env.state_dict())
    assert changes(python) == []


def test_parts_have_the_names_of_the_config():
    env = MaskedTransformedEnv(
        puck_env(episode_length_s=1.0), ObservationScale([("obs", "position")], scale=2.0)
    )
    names = set(python_parts(env))
    assert {
        "rewards.position",
        "events.launch",
        "terminations.beyond",
        "terminations.time_out",
    } <= names
    assert {
        "observations.last_action",
        "actions.push",
        "transforms[0] ObservationScale",
        "cfg",
        "view",
    } <= names


def test_an_env_of_others_is_a_part_as_a_whole():
    env = CounterEnv()
    assert list(python_parts(env)) == ["CounterEnv"]
    python = known(env)
    env.factor = 2.0
    assert changes(python) == ["CounterEnv.factor was (absent) and is 2.0"]


@dataclass(frozen=True, kw_only=True)
class Zero(MetricTerm):
    def __call__(self, view):
        return torch.zeros(view.num_envs)


@pytest.mark.parametrize(
    ("term", "name", "value", "instead"),
    [
        ("rewards.position", "weight", 2.0, r"env\.view\.reward_weights"),
        ("metrics.zero", "reduce", "sum", "build another env"),
        ("events.launch", "mode", "startup", "build another env"),
        ("terminations.beyond", "time_out", True, "build another env"),
    ],
)
def test_what_managers_have_read_is_refused_with_what_to_do_instead(term, name, value, instead):
    env = puck_env(metrics={"zero": Zero()})
    python = known(env)
    kind, of = term.split(".")
    object.__setattr__(getattr(env.cfg, kind)[of], name, value)
    with pytest.raises(
        FrozenPythonError, match=rf"{term}\.{name} was .*, without effect: .*{instead}"
    ):
        python.changes()


def test_what_a_step_reads_of_the_config_follows():
    env = puck_env()
    python = known(env)
    object.__setattr__(env.cfg, "decimation", 2)
    object.__setattr__(env.cfg.events["launch"], "speed", 3.0)
    assert changes(python) == [
        "events.launch.speed was 1.0 and is 3.0",
        "env.cfg.decimation was 4 and is 2",
    ]


class Graph:
    """Stands for a CUDA graph."""

    def __init__(self, device="cuda", *, is_eager=False):
        self.device, self.is_eager, self.forgotten = torch.device(device), is_eager, 0

    def forget(self):
        self.forgotten += 1


def test_a_graph_is_forgotten_when_python_has_changed():
    env, graph = puck_env(), Graph()
    followed, step = FollowedGraph(env, graph), stepping(env)
    for _ in range(3):
        with followed.calling():
            step()
    followed.follow()
    assert graph.forgotten == 0
    object.__setattr__(env.cfg.rewards["position"], "scale", 2.0)
    followed.follow()
    assert graph.forgotten == 1
    # Two steps show again what Python does, and nothing has changed since.
    for _ in range(3):
        with followed.calling():
            step()
        followed.follow()
    assert graph.forgotten == 1


@pytest.mark.parametrize("graph", [Graph("cpu"), Graph(is_eager=True)])
def test_where_nothing_is_recorded_python_may_do_what_it_likes(graph):
    env = puck_env(rewards={"remembering": Remembering()})
    followed, step = FollowedGraph(env, graph), stepping(env)
    for _ in range(4):
        with followed.calling():
            step()
        followed.follow()
    assert graph.forgotten == 0
