"""Curricula that change ranges of commands and weights of rewards."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.envs import EnvView, RewardTerm
from ksim_rl.testing import count_syncs
from tests.envs.probe_env import DT, Beyond, Position, puck_env

HEIGHT = mdp.BaseHeightCommand(resampling_time_range_s=(DT, DT), height=(0.2, 0.4))


def env_with(*, steps=2, **curriculum):
    return puck_env(
        num_envs=50,
        limit=None,
        episode_length_s=steps * DT,
        rewards={"position": Position(weight=1.0)},
        commands={"height": HEIGHT},
        curriculum=curriculum,
    )


def run(env, steps):
    """Step through the ends of episodes; return what each step showed: weights and the extremes of the command."""
    root_E, weights, lows, highs = env.reset(), [], [], []
    for _ in range(steps):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(env.num_envs, 1)))
        weights.append(float(env.view.reward_weights["position"]))
        lows.append(float(root_E["command", "height"].min()))
        highs.append(float(root_E["command", "height"].max()))
    return weights, lows, highs


def test_weights_follow_their_stages_when_envs_reset():
    env = env_with(weight=mdp.RewardWeightByStage(reward="position", stages={3: 5.0, 6: -2.0}))
    weights, _, _ = run(env, 8)
    assert weights == [1, 1, 1, 5, 5, -2, -2, -2]
    assert env.curriculum_levels()["weight"] == -2.0


def test_a_stage_at_step_zero_holds_from_the_start():
    weights, _, _ = run(
        env_with(weight=mdp.RewardWeightByStage(reward="position", stages={0: 0.0})), 1
    )
    assert weights == [0.0]


def test_weights_follow_the_level():
    level = mdp.LinearLevel(end_step=8)
    env = env_with(
        level=level, weight=mdp.RewardWeightByLevel(reward="position", start=-1.0, end=1.0)
    )
    assert run(env, 8)[0] == [-1, -0.5, -0.5, 0, 0, 0.5, 0.5, 1]


def test_the_reward_is_paid_at_the_weight_of_its_step():
    env = env_with(weight=mdp.RewardWeightByStage(reward="position", stages={2: 10.0}))
    root_E, rewards = env.reset(), []
    for _ in range(4):
        env_state_E, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(50, 1)))
        rewards.append(float(env_state_E["next", "reward"][0]))
    # Env 0 is at 0.02 m and 0.04 m in the two steps of each episode.
    assert rewards == pytest.approx([0.02 * DT, 0.04 * DT, 10 * 0.02 * DT, 10 * 0.04 * DT])


def test_ranges_follow_their_stages_and_fields_that_a_stage_leaves_out_stay():
    env = env_with(
        ranges=mdp.CommandRangesByStage(command="height", stages={4: {"height": (0.5, 0.6)}})
    )
    _, lows, highs = run(env, 8)
    assert min(lows[:3]) >= 0.2 and max(highs[:3]) <= 0.4
    assert min(lows[3:]) >= 0.5 and max(highs[3:]) <= 0.6
    assert env.curriculum_levels()["ranges"] == 1.0


def test_ranges_follow_the_level():
    start, end = {"height": (0.3, 0.3)}, {"height": (0.2, 0.4)}
    env = env_with(
        level=mdp.LinearLevel(end_step=8),
        ranges=mdp.CommandRangesByLevel(command="height", start=start, end=end),
    )
    _, lows, highs = run(env, 8)
    for step, share in enumerate((0, 0.25, 0.25, 0.5, 0.5, 0.75, 0.75, 1)):
        assert 0.3 - 0.1 * share - 1e-6 <= lows[step] <= 0.3 - 0.08 * share + 1e-6
        assert 0.3 + 0.08 * share - 1e-6 <= highs[step] <= 0.3 + 0.1 * share + 1e-6
    torch.testing.assert_close(
        env.view.command_ranges["height"]["height"], torch.tensor([0.2, 0.4])
    )


def test_a_velocity_commands_yaw_range_bounds_its_heading_control_too():
    command = mdp.UniformVelocityCommand(
        resampling_time_range_s=(DT, DT),
        lin_vel_x=(1.0, 2.0),
        lin_vel_y=(0.0, 0.0),
        ang_vel_z=(-0.5, 0.5),
        heading=(3.0, 3.0),
        rel_heading_envs=1.0,
    )
    stages = {2: {"ang_vel_z": (-0.1, 0.1), "lin_vel_x": (0.0, 0.5)}}
    env = puck_env(
        limit=None,
        episode_length_s=2 * DT,
        commands={"twist": command},
        curriculum={"ranges": mdp.CommandRangesByStage(command="twist", stages=stages)},
    )
    root_E = env.reset()
    assert (root_E["command", "twist"][:, 2] == 0.5).all() and (
        root_E["command", "twist"][:, 0] >= 1.0
    ).all()
    for _ in range(2):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
    torch.testing.assert_close(root_E["command", "twist"][:, 2], torch.full((3,), 0.1))
    assert (root_E["command", "twist"][:, 0] <= 0.5).all()


def test_they_never_make_the_host_wait_and_are_part_of_the_state():
    def env():
        ranges = {"height": (0.3, 0.3)}
        return env_with(
            level=mdp.LinearLevel(end_step=20),
            length=mdp.RewardWeightByLevel(reward="position", start=0.0, end=2.0),
            ranges=mdp.CommandRangesByLevel(
                command="height", start=ranges, end={"height": (0.1, 0.5)}
            ),
        )

    first, second = env(), env()
    root_E, action = first.reset(), torch.zeros(50, 1)
    with count_syncs() as syncs:
        for _ in range(5):
            _, root_E = first.step_and_maybe_reset(root_E.set("action", action))
    assert syncs.total == 0, syncs.report()
    second.reset()
    second.load_state_dict(first.state_dict())
    for _ in range(5):
        state_E, next_root_E = first.step_and_maybe_reset(root_E.clone().set("action", action))
        twin_E, _ = second.step_and_maybe_reset(root_E.clone().set("action", action))
        assert torch.equal(
            state_E["next", "command", "height"], twin_E["next", "command", "height"]
        )
        assert torch.equal(state_E["next", "reward"], twin_E["next", "reward"])
        root_E = next_root_E


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mdp.RewardWeightByStage(reward="position", stages={}), r"stages=\{\}"),
        (lambda: mdp.RewardWeightByStage(reward="position", stages={-1: 1.0}), "stages key -1"),
        (
            lambda: mdp.CommandRangesByStage(command="h", stages={1: {"x": (1.0, 0.0)}}),
            r"stages\.1\.x",
        ),
        (
            lambda: mdp.CommandRangesByLevel(
                command="h", start={"x": (0.0, 1.0)}, end={"y": (0.0, 1.0)}
            ),
            "start has the fields",
        ),
        (
            lambda: env_with(weight=mdp.RewardWeightByStage(reward="positon", stages={1: 1.0})),
            "unknown reward 'positon': did you mean 'position'",
        ),
        (
            lambda: env_with(
                ranges=mdp.CommandRangesByStage(
                    command="heigth", stages={1: {"height": (0.0, 1.0)}}
                )
            ),
            "unknown command with ranges 'heigth': did you mean 'height'",
        ),
        (
            lambda: env_with(
                ranges=mdp.CommandRangesByStage(command="height", stages={1: {"hight": (0.0, 1.0)}})
            ),
            "unknown range of the command 'height' 'hight': did you mean 'height'",
        ),
    ],
)
def test_what_does_not_fit_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@dataclass(frozen=True, kw_only=True)
class Travelled(RewardTerm):
    """`factor` times the way since the last step, m, from a buffer of its own, plus `offset`."""

    factor: float = 1.0
    offset: float = 0.0

    def __call__(self, view: EnvView) -> Tensor:
        last_E1 = view.buffer("last_E1", 1)
        way_E1 = view.joint_pos_EL - last_E1
        last_E1.copy_(view.joint_pos_EL)
        return self.factor * way_E1[:, 0] + self.offset


def test_fields_of_a_reward_follow_their_stages_and_each_keeps_its_own_memory():
    stages = {3: {"factor": 10.0}, 5: {"offset": 1.0}}
    env = puck_env(
        limit=None,
        episode_length_s=2 * DT,
        rewards={"way": Travelled(weight=2.0)},
        curriculum={"way": mdp.RewardFieldsByStage(reward="way", stages=stages)},
    )
    root_E, rewards = env.reset(), []
    with count_syncs() as syncs:
        for _ in range(8):
            step_E, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
            rewards.append(step_E["next", "reward"][:, 0].clone())
    assert syncs.total == 0, syncs.report()
    # Env e goes 0.02 (e + 1) m in each step. Stages change at resets: after the steps 4 and 6.
    way_E = 0.02 * torch.arange(1, 4)
    expected = [way_E] * 4 + [10 * way_E] * 2 + [10 * way_E + 1.0] * 2
    torch.testing.assert_close(torch.stack(rewards), 2.0 * DT * torch.stack(expected))
    assert env.curriculum_levels()["way"] == 2.0


def test_fields_of_a_termination_follow_their_stages():
    env = puck_env(
        limit=None,
        terminations={"beyond": Beyond(limit=0.05)},
        curriculum={
            "limit": mdp.TerminationFieldsByStage(termination="beyond", stages={4: {"limit": 0.09}})
        },
    )
    root_E, lengths = env.reset(), [[], [], []]
    for _ in range(12):
        before = env.episode_step_E.clone()
        step_E, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
        for row in torch.nonzero(step_E["next", "done"][:, 0]).flatten().tolist():
            lengths[row].append(int(before[row]) + 1)
    # Beyond 0.05 m after 3, 2 and 1 steps; beyond 0.09 m after 5, 3 and 2: from the first reset after step 4 on.
    assert lengths == [[3, 5], [2, 2, 3, 3], [1, 1, 1, 1, 2, 2, 2, 2]]


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (
            mdp.RewardFieldsByStage(reward="wai", stages={1: {"factor": 2.0}}),
            "unknown reward.*'wai'.*'way'",
        ),
        (mdp.RewardFieldsByStage(reward="way", stages={1: {"facto": 2.0}}), "'facto'.*'factor'"),
        (mdp.RewardFieldsByStage(reward="way", stages={1: {"weight": 2.0}}), "'weight'"),
        (mdp.RewardFieldsByStage(reward="way", stages={1: {"factor": "much"}}), "factor='much'"),
    ],
)
def test_stages_of_fields_that_do_not_exist_are_refused(term, message):
    with pytest.raises(ValueError, match=message):
        puck_env(limit=None, rewards={"way": Travelled()}, curriculum={"way": term})
