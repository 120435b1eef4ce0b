"""The comparison with the C engine passes for a robot in contact, and names the one row that differs."""

import pytest

from ksim_rl import envs
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.testing import check_physics
from ksim_rl.testing.check_physics import SUBSTEPS, check_c_engine


@pytest.fixture(scope="module")
def env():
    env = envs.make("quadruped_velocity_flat", num_envs=8, seed=0)
    env.reset()
    yield env
    env.close()


def wrong_in(rows, by):
    step = WarpWorld.step

    def wrong(world, n=1, **kwargs):
        step(world, n, **kwargs)
        if n == SUBSTEPS:
            world.qvel_EL[rows, 9] += by

    return wrong


def test_a_robot_in_contact_agrees_in_all_rows(env):
    check_c_engine(env, 20)


@pytest.mark.parametrize(
    ("rows", "by", "message"),
    [
        ([3], 3.0, "in row 3 at joint 'front_right_roll'"),
        (range(8), 0.2, "the median row \\(allowed 0.001\\)"),
    ],
)
def test_what_differs_is_named(env, monkeypatch, rows, by, message):
    monkeypatch.setattr(WarpWorld, "step", wrong_in(list(rows), by))
    with pytest.raises(AssertionError, match=message):
        check_c_engine(env, 20)


def test_where_only_the_c_engine_stops_early_it_is_asked_to_solve_to_the_end(env, monkeypatch):
    # Not of the model that Warp has.
    monkeypatch.setattr(env.base_env.world.mj_model.opt, "iterations", 1)
    check_c_engine(env, 20)
    monkeypatch.setattr(check_physics, "SOLVED", 1)
    with pytest.raises(AssertionError, match="differs from the C engine's"):
        check_c_engine(env, 20)
