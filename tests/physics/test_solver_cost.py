"""The solver is honest: the cost of its accelerations never exceeds the cost that MuJoCo Warp's solver reaches."""

import os

import pytest

from benchmarks.agreement_models import QUADRUPED
from ksim_rl.physics import load_model
from ksim_rl.physics.newton import solver as newton
from tests.physics.solver_models import SYNTHETIC, check_cost

# Of these, one has all kinds of rows, and one a ball a thousand times lighter than its links: rounding eats pivots of
# the Hessian of its world 30.
SHORT = (8, 16)
ROBOTS = ("unitree_go1", "unitree_g1", "unitree_go2", "booster_t1", "unitree_a1", "robotis_op3")


@pytest.mark.parametrize(
    "index",
    [i if i in SHORT else pytest.param(i, marks=pytest.mark.full) for i in range(len(SYNTHETIC))],
)
def test_the_cost_on_synthetic_models(index):
    check_cost(load_model(SYNTHETIC[index].xml()), num_envs=64)


def test_the_cost_on_a_robot():
    check_cost(load_model(QUADRUPED), num_envs=16)


@pytest.mark.full
@pytest.mark.skipif(
    "MENAGERIE_ROOT" not in os.environ, reason="MENAGERIE_ROOT names no folder of robots"
)
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_cost_on_menagerie_robots(robot):
    check_cost(load_model(robot), num_envs=16)


@pytest.mark.parametrize("index", SHORT)
def test_a_solver_that_stops_early_fails(index, monkeypatch):
    whole = newton.solver

    def stops_early(m, d):
        def solve(**what):
            with monkeypatch.context() as context:
                context.setattr(m.opt, "iterations", 1)
                whole(m, d)(**what)

        return solve

    monkeypatch.setattr(newton, "solver", stops_early)
    with pytest.raises(AssertionError, match="MuJoCo Warp"):
        check_cost(load_model(SYNTHETIC[index].xml()), num_envs=64)


def test_the_models_cover_what_a_solver_meets():
    assert {model.condim for model in SYNTHETIC} == {1, 3, 4, 6}
    assert {model.cone for model in SYNTHETIC} == {"pyramidal", "elliptic"}
    assert {
        min(model.impratio for model in SYNTHETIC),
        max(model.impratio for model in SYNTHETIC),
    } == {
        1,
        100,
    }
    assert {0.001, 1000} <= {model.ratio for model in SYNTHETIC}
    assert {"joint", "connect", "weld"} <= {model.tie for model in SYNTHETIC}
    assert any(model.tendon for model in SYNTHETIC) and any(
        model.ball_joints for model in SYNTHETIC
    )
    sizes = {load_model(SYNTHETIC[index].xml()).nv for index in (0, 17)}
    assert sizes == {1, 64} and len(SYNTHETIC) == 20
