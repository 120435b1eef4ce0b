"""What a term keeps advances once per env step, and the readings are the same however the env is stepped."""

from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import StepCounter

from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.envs import (
    EnvView,
    ManagerBasedRlEnv,
    MaskedTransformedEnv,
    ObservationGroupCfg,
    ObservationTermCfg,
)
from ksim_rl.envs.term import CommandTerm, ObservationTerm
from ksim_rl.mdp import JointPos, ProjectedGravity
from ksim_rl.testing import check_env
from tests.envs.probe_env import Launch, puck_cfg

EPISODE, STEPS, ROWS = 4, 10, 3


@dataclass(frozen=True, kw_only=True)
class Count(ObservationTerm):
    """How often it was read: in the episode, since the env was built, and as all envs share it, [E, 3]."""

    def __call__(self, view: EnvView) -> Tensor:
        in_episode_E, ever_E = view.buffer("in_episode_E"), view.buffer("ever_E", keep=True)
        shared = view.shared("shared", 0.0)
        in_episode_E += 1
        ever_E += 1
        shared += 1
        return torch.stack((in_episode_E, ever_E, shared.expand(view.num_envs)), dim=-1)


@dataclass(frozen=True, kw_only=True)
class CountOfCommand(CommandTerm):
    """The same of a command's vector."""

    resampling_time_range_s: tuple[float, float] | None = None

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        """Draw nothing."""

    def __call__(self, view: EnvView) -> Tensor:
        return Count()(view)


def counting_env(**fields: Any) -> ManagerBasedRlEnv:
    """Build an env whose episodes end after 4 steps, or in row 2, which moves fast, after 2."""
    readings = {"count": Count(), "position": JointPos()}
    group = ObservationGroupCfg(
        terms={name: ObservationTermCfg(term=term) for name, term in readings.items()}
    )
    cfg = puck_cfg(
        num_envs=ROWS,
        observations={"actor": group, "critic": group},
        commands={"count": CountOfCommand()},
        events={"launch": Launch()},
        # 0.02 m per step and number of the row.
        limit=0.11,
        episode_length_s=EPISODE * 0.02,
        **fields,
    )
    return ManagerBasedRlEnv(cfg)


def idle(td):
    return td.set("action", torch.zeros(ROWS, 1))


def stepped_by_hand(env):
    root_E, seen = env.reset(), []
    for _ in range(STEPS):
        env_state_E, root_E = env.step_and_maybe_reset(idle(root_E))
        seen.append(env_state_E)
    return torch.stack(seen, dim=1)


def by_collector(env, *, compile):
    collector = RolloutCollector(env, idle, rollout_length=STEPS, cfg=CollectorCfg(compile=compile))
    return collector.collect()


def by_stock_collector(env):
    total = STEPS * ROWS
    return next(iter(Collector(env, idle, frames_per_batch=total, total_frames=total)))


WAYS = {
    "step_and_maybe_reset": stepped_by_hand,
    "env.rollout": lambda env: env.rollout(STEPS, idle, break_when_any_done=False),
    "RolloutCollector": lambda env: by_collector(env, compile=False),
    "compiled": lambda env: by_collector(env, compile=True),
    "a stock collector": by_stock_collector,
    "a stock TransformedEnv": lambda env: TransformedEnv(env, StepCounter()).rollout(
        STEPS, idle, break_when_any_done=False
    ),
    "a stock collector of a MaskedTransformedEnv": lambda env: by_stock_collector(
        MaskedTransformedEnv(env, [StepCounter()])
    ),
}
# Row 0 ends by time after 4 steps, row 2 by its position after 2: 0.02 * 3 * 2 = 0.12 m.
ROOTS = {0: [1, 2, 3, 4, 1, 2, 3, 4, 1, 2], 2: [1, 2, 1, 2, 1, 2, 1, 2, 1, 2]}
NEXTS = {0: [2, 3, 4, 5, 2, 3, 4, 5, 2, 3], 2: [2, 3, 2, 3, 2, 3, 2, 3, 2, 3]}


@pytest.mark.parametrize("way", WAYS)
def test_buffers_advance_once_per_env_step(way):
    rollout_ET = WAYS[way](counting_env())
    for row in (0, 2):
        assert rollout_ET["obs", "count"][row, :, 0].tolist() == ROOTS[row]
        assert rollout_ET["next", "obs", "count"][row, :, 0].tolist() == NEXTS[row]
        assert rollout_ET["command", "count"][row, :, 0].tolist() == ROOTS[row]
    # A row that ends keeps the command that its policy saw.
    assert rollout_ET["next", "command", "count"][0, :, 0].tolist() == [
        2,
        3,
        4,
        4,
        2,
        3,
        4,
        4,
        2,
        3,
    ]
    # What outlives episodes is read once per step, and once more where an episode begins.
    assert rollout_ET["obs", "count"][0, :, 1].tolist() == [1, 2, 3, 4, 6, 7, 8, 9, 11, 12]
    # What all envs share advances in steps alone, whoever is reset.
    assert rollout_ET["next", "obs", "count"][0, :, 2].tolist() == [*range(1, STEPS + 1)]
    assert rollout_ET["next", "command", "count"][0, 0, 2] == 1


def test_all_ways_give_the_same_bits():
    expected = stepped_by_hand(counting_env())
    for way, step in WAYS.items():
        found = step(counting_env())
        for key in (
            ("obs", "count"),
            ("obs", "position"),
            ("command", "count"),
            ("next", "obs", "count"),
        ):
            assert torch.equal(found[key], expected[key]), (way, key)


def test_a_reset_of_some_rows_advances_nothing_in_the_others():
    env = counting_env()
    root_E = idle(env.reset())
    root_E = env.step(root_E)["next"].exclude("reward")
    assert root_E["obs", "count"][:, 0].tolist() == [2, 2, 2]
    for _ in range(3):
        root_E = env.reset(root_E, env_ids=[1])
    assert root_E["obs", "count"][:, 0].tolist() == [2, 1, 2]
    assert env.step(idle(root_E))["next", "obs", "count"][:, 0].tolist() == [3, 2, 3]


def test_the_count_is_part_of_the_state():
    env = counting_env()
    root_E = env.step(idle(env.reset()))["next"].exclude("reward")
    saved = env.state_dict()
    expected = env.step(idle(root_E))["next", "obs", "count"].clone()
    env.load_state_dict(saved)
    assert torch.equal(env.step(idle(root_E))["next", "obs", "count"], expected)


def test_it_is_a_good_env():
    check_env(counting_env(), num_steps=6, skip=("syncs", "memory", "c_engine"))


def test_a_filter_of_the_library_advances_once_per_env_step():
    """As the same filter advances in a loop without any resets."""
    lagging = {"lag": ProjectedGravity(time_constant=0.1), "position": JointPos()}
    group = ObservationGroupCfg(
        terms={name: ObservationTermCfg(term=term) for name, term in lagging.items()}
    )
    env = ManagerBasedRlEnv(puck_cfg(observations={"actor": group, "critic": group}, limit=None))
    env.rollout(5, break_when_any_done=False)
    assert env.view.buffers.by_name()["observations/lag.steps_E"].tolist() == [6, 6, 6]
