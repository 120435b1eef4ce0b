"""The solver is honest on a GPU too, where a warp shares a world."""

import os

import pytest

from ksim_rl.physics import load_model
from tests.physics.solver_models import SYNTHETIC, check_cost
from tests.physics.test_solver_cost import ROBOTS

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("index", range(len(SYNTHETIC)))
def test_the_cost_on_synthetic_models(index):
    check_cost(load_model(SYNTHETIC[index].xml()), num_envs=256, device="cuda")


@pytest.mark.skipif(
    "MENAGERIE_ROOT" not in os.environ, reason="MENAGERIE_ROOT names no folder of robots"
)
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_cost_on_menagerie_robots(robot):
    check_cost(load_model(robot), num_envs=256, device="cuda")
