"""A session steps at the pace of the clock, does what it is asked between steps, and pauses at errors."""

import dataclasses

import pytest
import torch

from ksim_rl import envs
from ksim_rl.viewer import Conditions, Session
from ksim_rl.viewer.session import UntrainedAgent

TASK = "cartpole_swingup"


def session_of(task: str = TASK, agent: str = "zero", num_envs: int = 2, **changes) -> Session:
    cfg = dataclasses.replace(envs.make_cfg(task, [f"task.scene.num_envs={num_envs}"]), **changes)
    return Session(
        lambda conditions: envs.build(conditions.apply(cfg)), lambda env: UntrainedAgent(agent, env)
    )


@pytest.fixture
def clock(monkeypatch):
    """A clock that tests set, in place of the real one."""
    now = [0.0]
    monkeypatch.setattr("ksim_rl.viewer.session.time.monotonic", lambda: now[0])
    return now


def test_it_steps_as_time_passes(clock):
    session = session_of()
    session.advance()
    dt = session.ours.step_dt
    clock[0] += 3.5 * dt
    assert session.advance()
    assert session.steps == 3
    session.speed = 4.0
    clock[0] += dt
    session.advance()
    assert session.steps == 7  # and the half step of before is kept


def test_pause_single_step_and_reset(clock):
    session = session_of()
    session.ask(lambda: session.play(False))
    session.advance()
    clock[0] += 1.0
    assert not session.advance()
    session.ask(session.step_once)
    assert session.advance()
    assert session.steps == 1 and int(session.ours.episode_step_E[0]) == 1
    session.ask(session.reset)
    session.advance()
    assert session.ours.episode_step_E.tolist() == [0, 0]


def test_reward_terms_add_up_to_the_reward():
    session = session_of(agent="random")
    total = 0.0
    for _ in range(5):
        session.step_once()
        total += sum(session.rewards.values())
    assert set(session.rewards) == set(session.ours.cfg.rewards)
    assert total == pytest.approx(session.episode_return, abs=1e-6)


def test_an_error_pauses_and_is_kept_until_it_plays_again(clock):
    session = session_of()

    def agent(_):
        raise ZeroDivisionError("the policy broke")

    working, session.agent = session.agent, agent
    session.advance()
    clock[0] += 0.05
    assert session.advance()  # which a display has to show
    assert not session.playing
    assert (
        session.error == "ZeroDivisionError: the policy broke" and "def agent" not in session.error
    )
    assert "in agent" in session.trace
    session.agent = working
    session.ask(session.play)
    session.advance()
    clock[0] += 0.05
    session.advance()
    assert session.steps > 0 and not session.error


def test_a_push_moves_the_chosen_env_only():
    session = session_of()
    session.choose(1)
    before_EL = session.ours.world.qvel_EL.clone()
    session.push(2.0, direction=0.0)
    change_EL = session.ours.world.qvel_EL - before_EL
    assert change_EL[0].abs().max() == 0.0
    assert change_EL[1].tolist() == pytest.approx([2.0, 0.0], abs=1e-5)
    with pytest.raises(ValueError, match="env 2: expected 0 to 1"):
        session.choose(2)


def test_a_free_robot_is_pushed_sideways_and_steered():
    session = session_of("quadruped_velocity_flat")
    session.push(1.5, direction=torch.pi / 2)
    velocity = session.ours.view.entity("").root_lin_vel_w_EL[0].tolist()
    assert velocity[:2] == pytest.approx([0.0, 1.5], abs=1e-5)

    name = next(iter(session.ours.cfg.commands))
    fields = dict.fromkeys(session.ours.cfg.commands[name].ranges, 0.0)
    session.steer(name, {**fields, "lin_vel_x": 0.7, "ang_vel_z": -0.3})
    for _ in range(2):
        session.step_once()
    assert session.commands[name].tolist() == pytest.approx([0.7, 0.0, -0.3])
    session.change(Conditions(noise=False, delay=False, randomization=False, pushes=False))
    session.step_once()
    assert session.commands[name].tolist() == pytest.approx([0.7, 0.0, -0.3])
    session.steer(name, None)
    term = session.ours.cfg.commands[name]
    held = session.ours.view.command_ranges[name]
    assert {field: pair_2.tolist() for field, pair_2 in held.items()} == {
        field: pytest.approx(pair) for field, pair in term.ranges.items()
    }


def test_conditions_take_out_what_disturbs():
    cfg = envs.make_cfg("quadruped_velocity_flat")
    calm = Conditions(noise=False, delay=False, randomization=False, pushes=False).apply(cfg)
    assert not any(group.enable_noise for group in calm.observations.values())
    assert all(event.mode not in ("startup", "interval") for event in calm.events.values())
    assert not any(event.per_world_fields for event in calm.events.values())
    assert Conditions().apply(cfg) == dataclasses.replace(cfg, curriculum={})
