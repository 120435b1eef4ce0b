"""On a GPU, too, what changes in Python is followed in the next rollout, and what changes by itself is refused."""

import warnings
from dataclasses import dataclass

import pytest
import torch
from torchrl.envs.transforms import RewardClipping

from ksim_rl import envs
from ksim_rl.adapters.stepper import Stepper
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.envs.recorded_python import FrozenPythonError
from ksim_rl.trainers.evaluation import Evaluator
from tests.collectors.recorded_puck import Calling, Constant
from tests.collectors.test_recording import Hidden
from tests.collectors.test_refused_python import Counter, PythonRandom, WallClock
from tests.envs.probe_env import puck_cfg
from tests.gpu.no_syncs import no_syncs

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

COMPILED = pytest.mark.parametrize("compile", [True, False])


@dataclass
class Policy:
    """Acts by a number of its own, without force."""

    scale: float = 0.0
    counts: bool = False

    def __call__(self, td):
        self.scale += self.counts
        return td.set("action", torch.full((*td.batch_size, 1), self.scale, device="cuda"))


def env_of(term):
    cfg = puck_cfg(num_envs=64, rewards={"term": term}, scale_rewards_by_dt=False, limit=None)
    return envs.build(cfg, device="cuda")


def collector_of(term, policy=None, **cfg):
    return RolloutCollector(
        env_of(term), policy or Policy(), rollout_length=4, cfg=CollectorCfg(**cfg)
    )


def rewards_of(collector, count):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return [float(collector.collect()["next", "reward"].mean()) for _ in range(count)]


@COMPILED
@pytest.mark.parametrize("make", [Counter, WallClock, PythonRandom])
def test_python_that_changes_from_step_to_step_is_refused(make, compile):
    with pytest.raises(FrozenPythonError, match=r"rewards\.term"):
        rewards_of(collector_of(make(), compile=compile), 4)


@COMPILED
def test_a_policy_that_changes_from_step_to_step_is_refused(compile):
    with pytest.raises(FrozenPythonError, match=r"policy\.scale"):
        rewards_of(collector_of(Constant(), Policy(counts=True), compile=compile), 4)


@COMPILED
def test_what_is_changed_between_rollouts_follows(compile):
    collector = collector_of(Constant(), compile=compile)
    means = rewards_of(collector, 5)
    object.__setattr__(collector.env.cfg.rewards["term"], "scale", 2.0)
    means += rewards_of(collector, 5)
    # TorchRL's RewardScaling asks the device whether it is normal, which no graph can hold.
    collector.env.append_transform(RewardClipping(-3.0, 1.5))
    means += rewards_of(collector, 12)
    collector.env.view.reward_weights["term"].fill_(-1.0)
    means += rewards_of(collector, 1)
    assert means == [1.0] * 5 + [2.0] * 5 + [1.5] * 12 + [-2.0]
    assert collector._run.ready


@COMPILED
def test_a_policy_that_is_changed_between_rollouts_follows(compile):
    policy = Policy()
    collector = collector_of(Constant(), policy, compile=compile)
    rewards_of(collector, 5)
    policy.scale = 3.0
    with pytest.warns(RuntimeWarning, match=r"policy\.scale was 0\.0 and is 3\.0"):
        rollout_ET = collector.collect()
    assert (rollout_ET["action"] == 3.0).all()


@COMPILED
def test_what_nothing_shows_is_found_by_comparison(compile):
    term = Calling(ask=Hidden(1))
    collector = collector_of(term, compile=compile)
    rewards_of(collector, 5)
    term.ask.box.value = 2
    # Of 64 rows every seventh ends by a NaN action in a comparison, and rows that end so are paid nothing.
    with pytest.raises(FrozenPythonError, match=r"another rewards\.term in 55 rows"):
        rewards_of(collector, 12)


@COMPILED
def test_a_comparison_leaves_rollouts_as_they_are(compile, monkeypatch):
    def rollouts():
        torch.manual_seed(0)
        collector = collector_of(Constant(), compile=compile)
        return [collector.collect().clone() for _ in range(8)]

    compared = rollouts()
    monkeypatch.setattr("ksim_rl.collectors.recording.Recording._check", lambda *_: None)
    for own, true in zip(compared, rollouts(), strict=True):
        for key in true.keys(True, True):
            torch.testing.assert_close(own[key], true[key])


def test_with_eager_the_python_of_each_step_runs():
    means = rewards_of(collector_of(Counter(), eager=True), 8)
    assert means[0] == 0.0 and means[-1] == 1.0


def test_other_rollouts_than_those_with_a_comparison_never_wait():
    collector = collector_of(Constant())
    with no_syncs(on=False):
        rewards_of(collector, 4)
    with no_syncs():
        for _ in range(8):
            collector.collect()


def test_an_evaluation_follows_what_has_changed():
    env = env_of(Constant())
    evaluator = Evaluator(env, Policy(), max_steps=8, seed=0)  # pyright: ignore[reportArgumentType]
    returns = [evaluator().return_mean for _ in range(2)]
    object.__setattr__(env.cfg.rewards["term"], "scale", 2.0)
    returns += [evaluator().return_mean for _ in range(2)]
    assert returns == [8.0, 8.0, 16.0, 16.0]


def test_a_stepper_follows_what_has_changed_at_a_reset():
    env = env_of(Constant())
    stepper = Stepper(env)
    action = torch.zeros(64, 1, device="cuda")
    stepper.reset()
    rewards = [float(stepper.step(action).reward_E.mean()) for _ in range(5)]
    object.__setattr__(env.cfg.rewards["term"], "scale", 2.0)
    stepper.reset()
    rewards += [float(stepper.step(action).reward_E.mean()) for _ in range(5)]
    assert rewards == [1.0] * 5 + [2.0] * 5
