"""Where a term's option and a transform do the same, both give the same numbers: one line per pair of the docs."""

from dataclasses import dataclass
from typing import Literal

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.envs import EnvView, MaskedTransformedEnv, ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.term import MetricTerm
from ksim_rl.modules.network import ObservationNormalizer
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    ActionClip,
    ActionLowPass,
    ActionScale,
    EpisodeTracker,
    ObservationNormalization,
    RewardScale,
    SuccessTracker,
    TimeAwareObservation,
)
from ksim_rl.transforms.low_pass import smoothing
from tests.envs.probe_env import DT, Position, puck_env_in_c
from tests.mdp.bench import TWO_WHEELS

CUTOFF_HZ = 3.0


@pytest.mark.parametrize(
    ("option", "transform"),
    [
        ({"clip": (-0.25, 0.5)}, lambda dt: ActionClip(clip=(-0.25, 0.5))),
        ({"scale": 0.3, "offset": 0.1}, lambda dt: ActionScale(scale=0.3, offset=0.1)),
        (
            {"cutoff_hz": CUTOFF_HZ},
            lambda dt: ActionLowPass(alpha=smoothing(CUTOFF_HZ, dt), initial=0.0),
        ),
    ],
    ids=["clip", "scale", "low pass"],
)
def test_an_action_is_shaped_alike(make_bench, option, transform):
    bench = make_bench(TWO_WHEELS, 3)
    term = mdp.JointEffortAction(**option)
    size = term.size(bench.view)
    env = MaskedTransformedEnv(
        CounterEnv((9, 9, 9), action_size=size), [transform(bench.view.step_dt)]
    )
    env.reset()
    for step in range(4):
        action_EK = torch.randn(3, size, generator=torch.Generator().manual_seed(step))
        with bench.driver.scope("actions/x"):
            ours_EK = term.shaped(bench.view, action_EK.clone())
        theirs_EK = env.transform.inv(TensorDict({"action": action_EK}, batch_size=3))["action"]
        torch.testing.assert_close(ours_EK, theirs_EK, rtol=1e-6, atol=1e-7)
        assert not torch.equal(ours_EK, action_EK)


@dataclass(frozen=True, kw_only=True)
class Ones(MetricTerm):
    """1 in each step: its sum is the length of the episode."""

    reduce: Literal["mean", "last", "max", "sum"] = "sum"

    def __call__(self, view: EnvView) -> Tensor:
        return torch.ones(view.num_envs)


def test_time_left_successes_and_lengths_are_counted_alike():
    left = ObservationGroupCfg(terms={"left": ObservationTermCfg(term=mdp.RemainingTime())})
    metrics = {
        "success": mdp.Success(terminations=("time_out",)),
        "ever": mdp.Success(terminations=("time_out",), reduce="max"),
        "length": Ones(),
    }
    puck = puck_env_in_c(
        limit=0.11, episode_length_s=5 * DT, observations={"actor": left}, metrics=metrics
    )
    trackers = [
        EpisodeTracker(),
        SuccessTracker("truncated", reduce="last"),
        SuccessTracker("truncated", "episode_ever"),
        TimeAwareObservation("share_left"),
    ]
    env = MaskedTransformedEnv(puck, [TimeAwareObservation(normalize=False), *trackers])
    root_E, ended = env.reset(), []
    for _ in range(11):
        assert torch.equal(root_E["obs", "left"], root_E["remaining_time"] * puck.view.step_dt)
        assert torch.equal(root_E["remaining_time"] / 5, root_E["share_left"])
        data_E, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
        next_E = data_E["next"]
        ended.append(
            next_E.select("episode_success", "episode_ever", "episode_length")[next_E["done"][:, 0]]
        )
    episodes, log = torch.cat(ended), puck.episode_log()
    assert log["episodes"] == len(episodes) > 3
    assert log["metric/success"] == episodes["episode_success"].sum() > 0
    assert log["metric/ever"] == episodes["episode_ever"].sum() > 0
    assert log["metric/length"] == episodes["episode_length"].sum()


def test_ranges_weights_and_levels_move_alike():
    """A curriculum and a transform that follow one level, after episodes that all last long."""
    start, end, score = (0.2, 0.4), (-1.0, 2.0), 2.0
    puck = puck_env_in_c(
        num_envs=2,
        limit=None,
        episode_length_s=2 * DT,
        rewards={"position": Position(weight=1.0)},
        commands={"height": mdp.BaseHeightCommand(resampling_time_range_s=(DT, DT), height=start)},
        curriculum={
            "level": mdp.EpisodeLengthLevel(raise_above=0.5, num_levels=7),
            "ranges": mdp.CommandRangesByLevel(
                command="height", start={"height": start}, end={"height": end}
            ),
            "weight": mdp.RewardWeightByLevel(reward="position", start=-1.0, end=0.3),
        },
    )
    weight, root = RewardScale(scale=0.3, first_scale=-1.0), puck.reset(seed=5)
    for _ in range(9):
        root = puck.step_and_maybe_reset(root.set("action", torch.full((2, 1), score)))[1]
        level, ends = puck.view.level, torch.tensor((start, end))
        torch.testing.assert_close(
            puck.view.command_ranges["height"]["height"], torch.lerp(ends[0], ends[1], level)
        )
        weight.follow_level_(level)
        assert weight.new_value(0, torch.ones(1)) == puck.view.reward_weights["position"]
    assert 0.5 < level < 1.0


def test_observations_are_normalized_alike():
    seen, asked = torch.randn(100, 3), torch.randn(8, 3)
    network, transform = ObservationNormalizer(3), ObservationNormalization("x")
    transform._size_moments([3], None)
    for statistics in (network, transform.moments[0]):
        statistics.update(seen)
    theirs = transform(TensorDict({"x": asked.clone()}, batch_size=8))["x"]
    assert torch.equal(network(asked), theirs)
