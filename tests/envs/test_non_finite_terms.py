"""A term that gives a number that is not finite is named, with the env and the step where it was first."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Tensor

from ksim_rl import conf
from ksim_rl.envs import EnvView, ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.term import CommandTerm, MetricTerm, ObservationTerm, RewardTerm
from ksim_rl.testing import count_syncs
from ksim_rl.trainers import RunProgress, build
from tests.envs.probe_env import puck_env, push


def broken(view: EnvView, values_EK: Tensor, *, env: int, step: int, value: float) -> Tensor:
    """Put a value that is not finite into the first column of one env at one step of the env."""
    here_E = (torch.arange(view.num_envs, device=view.device) == env) & (view.step_count == step)
    values_EK[:, 0] = torch.where(here_E, value, values_EK[:, 0])
    return values_EK


@dataclass(frozen=True, kw_only=True)
class Broken:
    """Fields of the terms below: where and when they break, and what they give then."""

    env: int = 1
    step: int = 2
    value: Any = field(default=torch.nan)

    def ones(self, view: EnvView, width: int = 1) -> Tensor:
        ones_EK = torch.ones(view.num_envs, width, device=view.device)
        return broken(view, ones_EK, env=self.env, step=self.step, value=float(self.value))


@dataclass(frozen=True, kw_only=True)
class BrokenReward(Broken, RewardTerm):
    """1, but once."""

    def __call__(self, view: EnvView) -> Tensor:
        return self.ones(view)[:, 0]


@dataclass(frozen=True, kw_only=True)
class BrokenMetric(Broken, MetricTerm):
    """1, but once."""

    def __call__(self, view: EnvView) -> Tensor:
        return self.ones(view)[:, 0]


@dataclass(frozen=True, kw_only=True)
class BrokenObservation(Broken, ObservationTerm):
    """Ones, but once."""

    width: int = 2

    def __call__(self, view: EnvView) -> Tensor:
        return self.ones(view, self.width)


@dataclass(frozen=True, kw_only=True)
class BrokenCommand(Broken, CommandTerm):
    """1, but once."""

    resampling_time_range_s: tuple[float, float] | None = None

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        """Draw nothing."""

    def __call__(self, view: EnvView) -> Tensor:
        return self.ones(view)


def group(**terms):
    return {
        "actor": ObservationGroupCfg(
            terms={n: ObservationTermCfg(term=t) for n, t in terms.items()}
        )
    }


FAULTS = {
    "reward": lambda **at: {"rewards": {"fine": BrokenReward(step=-1), "odd": BrokenReward(**at)}},
    "metric": lambda **at: {"metrics": {"fine": BrokenMetric(step=-1), "odd": BrokenMetric(**at)}},
    "command": lambda **at: {
        "commands": {"fine": BrokenCommand(step=-1), "odd": BrokenCommand(**at)}
    },
    "observation": lambda **at: {
        "observations": group(fine=BrokenObservation(step=-1, width=3), odd=BrokenObservation(**at))
    },
    "the only observation": lambda **at: {"observations": group(odd=BrokenObservation(**at))},
}


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("kind", FAULTS)
def test_the_term_is_named_with_env_and_step(kind, value):
    env = puck_env(num_envs=4, limit=None, **FAULTS[kind](env=2, step=3, value=value))
    root_E = env.reset()
    for _ in range(2):
        root_E = push(env, root_E)["next"]
    assert env.non_finite_terms() == [] and float(env.episode_log()["non_finite_terms"]) == 0.0
    for _ in range(3):
        root_E = push(env, root_E)["next"]
    (line,) = env.non_finite_terms()
    said = kind.split()[-1]
    assert line.startswith(f"{said} 'odd' is not finite: first in env 2 at its step 3, 1 numbers")
    assert float(env.episode_log()["non_finite_terms"]) == 1.0
    env.episode_log_reset_()
    assert float(env.episode_log()["non_finite_terms"]) == 1.0, (
        "of the env's life, not of a rollout"
    )
    assert line in env.explain(width=200)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_sums_of_episodes_keep_the_finite_rewards(value):
    env = puck_env(num_envs=4, limit=None, **FAULTS["reward"](env=2, step=3, value=value))
    root_E = env.reset()
    rewards_TE = []
    for _ in range(5):
        root_E = push(env, root_E)["next"]
        rewards_TE.append(root_E["reward"].flatten())
    # The reward itself is not mended in silence.
    assert [row.isfinite().all().item() for row in rewards_TE] == [True, True, False, True, True]
    sums_E = env.reward_manager.episode_sums_ER[:, env.reward_manager.names.index("odd")]
    assert sums_E.isfinite().all()
    assert sums_E[2].item() == pytest.approx(0.8 * sums_E[0].item())


def test_watching_makes_no_host_sync_and_finite_terms_are_not_named():
    env = puck_env(num_envs=4, **FAULTS["reward"](step=-1))
    root_E = push(env, env.reset())["next"]
    with count_syncs() as syncs:
        push(env, root_E)
        env.episode_log()
    assert syncs.total == 0, syncs.report()
    assert env.non_finite_terms() == []


def test_a_run_says_once_which_term_it_was():
    cfg = conf.compose(
        ["num_envs=8", "data.num_env_states_per_minibatch=32", "data.num_minibatches=2"]
        + [
            "trainer.num_iterations=3",
            "trainer.eval_episodes=0",
            "logger.csv=false",
            "logger.tensorboard=false",
        ]
    )
    rewards = {**cfg.task.rewards, "odd": BrokenReward(env=5, step=11)}
    trainer = build(dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, rewards=rewards)))
    notes: list[str] = []
    progress = RunProgress(3, enabled=False)
    progress.note = notes.append
    trainer.train(progress)
    (said,) = (note for note in notes if "not finite" in note)
    assert said.startswith(
        "warning: reward 'odd' is not finite: first in env 5 at its step 11, 1 numbers so far"
    )
    assert "(iteration 2; said once)" in said
    assert int(trainer.update.metrics()["update/non_finite_env_states"]) >= 1


def test_no_term_is_named_for_a_world_whose_physics_failed():
    env = puck_env(num_envs=3, limit=None)
    root_E = env.reset()
    env.world.qvel_EL[1] = torch.nan
    push(env, root_E)
    assert env.view.terminations["non_finite"].tolist() == [False, True, False]
    assert env.non_finite_terms() == []
