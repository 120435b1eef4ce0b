"""The env's semantics, on a puck whose trajectory is known."""

import math

import mujoco
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.testing import count_syncs
from tests.envs.probe_env import (
    DT,
    Kick,
    Launch,
    RandomLaunch,
    Speed,
    Target,
    puck_cfg,
    puck_env,
    push,
)


def glide(env, root_E, steps):
    """Step without force, resetting envs that end; return the list of `next` tensordicts."""
    nexts = []
    for _ in range(steps):
        env_state_E, root_E = env.step_and_maybe_reset(
            root_E.set("action", torch.zeros(env.num_envs, 1))
        )
        nexts.append(env_state_E["next"].clone())
    return nexts, root_E


def test_check_env_specs():
    check_env_specs(puck_env(episode_length_s=0.1))


def test_attributes():
    env = puck_env(episode_length_s=0.19)
    assert env.is_vector_env and env.num_envs == 3 and env.batch_size == torch.Size([3])
    assert env.physics_dt == 0.005 and env.step_dt == pytest.approx(DT)
    assert env.max_episode_length_s == 0.19 and env.max_episode_length == math.ceil(0.19 / DT) == 10
    assert env.metadata["render_modes"] == [None, "rgb_array"] and env.metadata["mujoco_version"]
    assert env.unwrapped is env and env.render() is None


def test_a_whole_number_of_steps_is_not_rounded_up():
    assert puck_env(episode_length_s=20.0).max_episode_length == 1000


def test_positions_follow_the_closed_form():
    env = puck_env(limit=None)
    nexts, _ = glide(env, env.reset(), 5)
    speed_E1 = torch.tensor([[1.0], [2.0], [3.0]])
    for k, next_E in enumerate(nexts, start=1):
        torch.testing.assert_close(next_E["obs", "position"], speed_E1 * DT * k)
        torch.testing.assert_close(next_E["reward"], speed_E1 * DT * k * DT)


def test_reward_is_not_scaled_by_dt_if_told_so():
    env = puck_env(limit=None, scale_rewards_by_dt=False)
    nexts, _ = glide(env, env.reset(), 1)
    torch.testing.assert_close(nexts[0]["reward"], nexts[0]["obs", "position"])


def test_next_holds_the_true_terminal_observation_and_the_root_the_reset_one():
    env = puck_env(limit=0.1)  # env 2 moves 0.06 m a step: beyond 0.1 m at step 2
    nexts, root_E = glide(env, env.reset(), 2)
    last = nexts[-1]
    assert last["done"][:, 0].tolist() == [False, False, True]
    assert last["terminated"][2] and not last["truncated"][2]
    torch.testing.assert_close(last["obs", "position"][2], torch.tensor([0.12]))
    torch.testing.assert_close(root_E["obs", "position"][:, 0], torch.tensor([0.04, 0.08, 0.0]))
    torch.testing.assert_close(root_E["obs", "velocity"][:, 0], torch.tensor([1.0, 2.0, 3.0]))


def test_rows_that_go_on_keep_their_next_observation_bit_for_bit():
    env = puck_env(limit=0.1)
    nexts, root_E = glide(env, env.reset(), 2)
    for key in (("obs", "position"), ("obs", "velocity"), ("obs", "last_action")):
        assert torch.equal(root_E[key][:2], nexts[-1][key][:2])


def test_time_out_truncates_at_the_max_episode_length():
    env = puck_env(limit=None, episode_length_s=3 * DT)
    nexts, root_E = glide(env, env.reset(), 3)
    assert [bool(n["truncated"].any()) for n in nexts] == [False, False, True]
    assert not nexts[-1]["terminated"].any() and nexts[-1]["done"].all()
    assert root_E["obs", "position"].eq(0).all()


def test_finite_horizon_terminates_instead():
    env = puck_env(limit=None, episode_length_s=3 * DT, is_finite_horizon=True)
    nexts, _ = glide(env, env.reset(), 3)
    assert nexts[-1]["terminated"].all() and not nexts[-1]["truncated"].any()


def test_without_terminations_an_episode_never_ends():
    env = puck_env(limit=None)
    nexts, _ = glide(env, env.reset(), 50)
    assert not any(n["done"].any() for n in nexts)


def test_partial_reset_leaves_other_rows_bit_identical():
    env = puck_env(limit=None)
    _, root_E = glide(env, env.reset(), 3)
    before = env.world.qpos_EL.clone()
    fresh_E = env.reset(env_ids=[1])
    assert env.world.qpos_EL[1] == 0 and torch.equal(env.world.qpos_EL[[0, 2]], before[[0, 2]])
    assert torch.equal(fresh_E["obs", "position"][[0, 2]], root_E["obs", "position"][[0, 2]])
    assert fresh_E["obs", "position"][1] == 0


def test_reset_refuses_unknown_keywords():
    env = puck_env()
    with pytest.raises(TypeError, match="env_idx"):
        env.reset(env_idx=[0])
    with pytest.raises(ValueError, match="options"):
        env.reset(options={"wind": 1})


def test_the_constructor_refuses_unknown_keywords():
    with pytest.raises(TypeError, match="num_worlds"):
        ManagerBasedRlEnv(puck_cfg(), num_worlds=3)  # pyright: ignore[reportCallIssue]
    with pytest.raises(ValueError, match="device='gpu': expected 'cpu', 'cuda' or 'cuda:<index>'"):
        ManagerBasedRlEnv(puck_cfg(), device="gpu")


@pytest.mark.parametrize(
    "action", [torch.zeros(3), torch.zeros(3, 2), torch.zeros(3, 1, dtype=torch.float64)]
)
def test_a_wrong_action_is_refused_with_both_shapes(action):
    env = puck_env()
    root_E = env.reset()
    with pytest.raises(ValueError, match=r"\(3, 1\)"):
        env.step(TensorDict({"action": action}, batch_size=[3]))
    assert env.world.qpos_EL.eq(0).all(), root_E


def test_a_non_finite_action_ends_that_env_only():
    env, twin = puck_env(limit=None), puck_env(limit=None)
    root_E, twin_root_E = env.reset(), twin.reset()
    action = torch.zeros(3, 1)
    action[1] = torch.nan
    next_E = env.step(root_E.set("action", action))["next"]
    twin_E = push(twin, twin_root_E)["next"]
    assert next_E["terminated"][:, 0].tolist() == [False, True, False]
    assert all(torch.isfinite(leaf).all() for leaf in next_E.values(True, True))
    assert torch.equal(next_E["obs", "position"][[0, 2]], twin_E["obs", "position"][[0, 2]])
    assert next_E["reward"][1] == 0 and env.episode_log()["termination/non_finite"] == 1


@pytest.mark.parametrize("speed", [math.inf, 2.0 * mujoco.mjMAXVAL])
def test_physics_gone_bad_ends_that_env_and_is_gone_after_the_reset(speed):
    """MuJoCo's C engine resets a state beyond `mjMAXVAL` as it does one that is not finite."""
    env, twin = puck_env(limit=None), puck_env(limit=None)
    root_E, twin_root_E = env.reset(), twin.reset()
    env.world.qvel_EL[2] = speed
    env_state_E, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
    assert env_state_E["next", "terminated"][:, 0].tolist() == [False, False, True]
    assert all(torch.isfinite(leaf).all() for leaf in env_state_E.values(True, True))
    twin_state_E, twin_root_E = twin.step_and_maybe_reset(
        twin_root_E.set("action", torch.zeros(3, 1))
    )
    after, expected = push(env, root_E)["next"], push(twin, twin_root_E)["next"]
    assert torch.equal(after["obs", "position"][:2], expected["obs", "position"][:2])
    torch.testing.assert_close(after["obs", "position"][2], torch.tensor([3 * DT]))


def test_force_accelerates_the_puck():
    env = puck_env(limit=None, events={})
    next_E = push(env, env.reset(), force=2.0)["next"]
    torch.testing.assert_close(next_E["obs", "velocity"], torch.full((3, 1), 2.0 * DT))
    assert next_E["obs", "last_action"].eq(2.0).all()


def test_interval_events_fire_by_each_envs_clock():
    kick = Kick(mode="interval", interval_range_s=(3 * DT, 3 * DT))
    env = puck_env(limit=None, events={"launch": Launch(speed=0.0), "kick": kick})
    nexts, _ = glide(env, env.reset(), 7)
    assert [round(float(n["obs", "velocity"][0])) for n in nexts] == [0, 0, 1, 1, 1, 2, 2]


def test_step_events_fire_at_every_step():
    env = puck_env(limit=None, events={"launch": Launch(speed=0.0), "kick": Kick(mode="step")})
    nexts, _ = glide(env, env.reset(), 3)
    assert [round(float(n["obs", "velocity"][1])) for n in nexts] == [1, 2, 3]


def test_commands_resample_by_their_clock_and_rows_that_end_keep_theirs():
    command = Target(resampling_time_range_s=(2 * DT, 2 * DT))
    env = puck_env(limit=None, episode_length_s=4 * DT, commands={"target": command})
    root_E = env.reset()
    first = root_E["command", "target"].clone()
    nexts, root_E = glide(env, root_E, 4)
    targets = [n["command", "target"] for n in nexts]
    assert torch.equal(targets[0], first) and not torch.equal(targets[1], first)
    assert torch.equal(targets[2], targets[1])
    assert torch.equal(targets[3], targets[2]), "ended rows keep the command that the policy saw"
    assert not torch.equal(root_E["command", "target"], targets[3])
    assert len(targets[1].unique()) == 3, "envs draw apart"


def test_metrics_and_episode_log():
    env = puck_env(limit=None, episode_length_s=2 * DT, metrics={"speed": Speed(reduce="max")})
    glide(env, env.reset(), 5)  # two episodes per env have ended
    log = env.episode_log()
    assert log["episodes"] == 6 and log["length_sum"] == 12 and log["termination/time_out"] == 6
    torch.testing.assert_close(log["metric/speed"], torch.tensor(2 * (1.0 + 2.0 + 3.0)))
    per_episode = sum(v * DT * (1 + 2) * DT for v in (1.0, 2.0, 3.0))
    torch.testing.assert_close(log["return_sum"], torch.tensor(2 * per_episode))
    torch.testing.assert_close(log["reward/position"], log["return_sum"])
    env.episode_log_reset_()
    assert env.episode_log()["episodes"] == 0


def test_the_same_seed_gives_the_same_rollout_and_another_does_not():
    def rollout(seed):
        env = puck_env(events={"launch": RandomLaunch()}, limit=0.03, seed=seed)
        nexts, _ = glide(env, env.reset(), 6)
        return torch.stack([n["obs", "position"] for n in nexts])

    assert torch.equal(rollout(3), rollout(3))
    assert not torch.equal(rollout(3), rollout(4))


def test_one_rows_reset_does_not_change_anothers_numbers():
    env = puck_env(events={"launch": RandomLaunch()}, limit=None)
    twin = puck_env(events={"launch": RandomLaunch()}, limit=None)
    env.reset(), twin.reset()
    twin.reset(env_ids=[0])
    twin.reset(env_ids=[0])
    assert torch.equal(
        env.reset(env_ids=[2])["obs", "velocity"][2], twin.reset(env_ids=[2])["obs", "velocity"][2]
    )


def test_seed_returns_and_stores_the_seed_used():
    env = puck_env()
    assert env.seed(7) == 7 and env.cfg.seed == 7
    drawn = env.seed()
    assert drawn >= 0 and env.cfg.seed == drawn
    assert env.set_seed(3) != 3, "TorchRL's set_seed returns the next seed"


def test_state_dict_continues_bit_exactly():
    def fresh():
        events = {
            "launch": RandomLaunch(),
            "kick": Kick(mode="interval", interval_range_s=(DT, 4 * DT)),
        }
        command = {"target": Target(resampling_time_range_s=(DT, 3 * DT))}
        return puck_env(events=events, limit=0.1, commands=command)

    env = fresh()
    _, root_E = glide(env, env.reset(), 5)
    saved, saved_root_E = env.state_dict(), root_E.clone()
    expected, _ = glide(env, root_E, 8)
    other = fresh()
    other.seed(99)
    other.reset()
    other.load_state_dict(saved)
    actual, _ = glide(other, saved_root_E, 8)
    for a, b in zip(actual, expected, strict=True):
        assert all(torch.equal(a[key], b[key]) for key in b.keys(True, True))


def test_state_of_another_env_is_refused():
    with pytest.raises(ValueError, match="state of an env .of the same config and num_envs"):
        puck_env(num_envs=2).load_state_dict(puck_env(num_envs=3).state_dict())


def test_step_and_reset_never_make_the_host_wait():
    events = {
        "launch": RandomLaunch(),
        "kick": Kick(mode="interval", interval_range_s=(DT, 4 * DT)),
    }
    env = puck_env(
        events=events,
        limit=0.05,
        episode_length_s=5 * DT,
        commands={"target": Target(resampling_time_range_s=(DT, 3 * DT))},
        metrics={"speed": Speed()},
    )
    root_E = env.reset()
    with count_syncs() as syncs:
        glide(env, root_E, 8)
    assert syncs.total == 0, syncs.report()


def test_close_twice_is_an_error_unless_told_otherwise():
    env = puck_env()
    env.close()
    with pytest.raises(RuntimeError, match="closed"):
        env.close()
    env.close(raise_if_closed=False)
