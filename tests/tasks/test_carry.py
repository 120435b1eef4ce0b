"""G1 and its box: rewards against their formulas in states that are set, and what ends or wins an episode."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.tasks.carry import BOX, PALM_ROOM, PALMS, STAND_HEIGHT

pytestmark = pytest.mark.full  # it needs the model of G1, which is large
E = 3


@pytest.fixture(scope="module")
def env():
    cfg = envs.make_cfg("g1_carry_box", [f"task.scene.num_envs={E}", "task.sim.engine=c"])
    return envs.build(dataclasses.replace(cfg, seed=2))


@pytest.fixture
def base(env):
    env.reset()
    return env.base_env


def put_box(base, pos_E3, quat_4=(1.0, 0.0, 0.0, 0.0)):
    everybody_E = torch.ones(E, dtype=torch.bool)
    quat_E4 = torch.tensor(quat_4).expand(E, 4)
    base.view.entity("box").write_root_pose(everybody_E, pos_E3, quat_E4)
    base.driver.changed()
    base.world.refresh()
    base.driver.refreshed()


def half_edges(base):
    place = base.world.mj_model.geom(BOX).id
    return base.view.field("geom_size")[:, place]


def test_the_box_stands_on_its_stand_before_the_robot(base):
    half_E3 = half_edges(base)
    assert half_E3.std(0).min() > 0.001, "each world has a box of its own"
    pos_E3 = base.view.body(BOX).pos_EL
    torch.testing.assert_close(pos_E3[:, 2], STAND_HEIGHT + half_E3[:, 2])
    assert (pos_E3[:, 0] - base.view.robot.root_pos_EL[:, 0] > 0.3).all()
    assert base.observation_spec["obs", "to_place"].shape == (E, 3)


def test_palms_pay_where_they_hold_the_box(base):
    term = base.cfg.rewards["palms"]
    # Turned about a slanted axis, the box has sides in all directions.
    quat_4 = (0.8, 0.0, 0.36, 0.48)
    put_box(base, base.view.body(BOX).pos_EL + 0.02, quat_4)
    matrix_9 = np.zeros(9)
    mujoco.mju_quat2Mat(matrix_9, np.array(quat_4))
    y_3 = matrix_9.reshape(3, 3)[:, 1]
    half_E = half_edges(base)[:, 1].double().numpy() + PALM_ROOM
    middle_E3 = base.view.body(BOX).pos_EL.double().numpy()
    palms_EN3 = base.view.sites(PALMS).pos_EN3.double().numpy()
    wanted_EN3 = np.stack(
        (middle_E3 + half_E[:, None] * y_3, middle_E3 - half_E[:, None] * y_3), axis=1
    )
    error_E = ((palms_EN3 - wanted_EN3) ** 2).sum(-1).mean(-1)
    term = dataclasses.replace(term, std=0.5)
    np.testing.assert_allclose(term(base.view), np.exp(-error_E / 0.25), rtol=1e-4)


def test_the_place_pays_as_far_as_the_box_is_up(base):
    lifted, carried = base.cfg.rewards["lifted"], base.cfg.rewards["place"]
    place_E3 = base.view.command("place")
    half_E3 = half_edges(base)
    rest_E = STAND_HEIGHT + half_E3[:, 2]
    # On the edge along x, an eighth of a turn from upright.
    tipped_E = STAND_HEIGHT + half_E3[:, 1:].sum(-1) * 0.5**0.5
    tipped = (math.cos(math.pi / 8.0), math.sin(math.pi / 8.0), 0.0, 0.0)
    upright = (1.0, 0.0, 0.0, 0.0)
    pos_E3 = place_E3 + torch.tensor([0.05, 0.0, 0.0])
    for low_E, quat_4, rise, share in (
        (rest_E, upright, -0.1, 0.0),
        (rest_E, upright, 0.03, 0.5),
        (rest_E, upright, 0.3, 1.0),
        (tipped_E, tipped, 0.0, 0.0),
        (tipped_E, tipped, 0.03, 0.5),
    ):
        pos_E3[:, 2] = low_E + rise
        put_box(base, pos_E3, quat_4)
        torch.testing.assert_close(lifted(base.view), torch.full((E,), share), atol=1e-4, rtol=0.0)
        off_E = (pos_E3 - place_E3).square().sum(-1)
        torch.testing.assert_close(
            carried(base.view), share * torch.exp(-off_E / 0.15**2), atol=1e-4, rtol=0.0
        )


def test_a_box_at_its_place_wins_and_one_on_the_ground_ends(base):
    place_E3 = base.view.command("place").clone()
    success, dropped = base.cfg.metrics["success"], base.cfg.terminations["dropped"]
    for away, wins in ((0.09, 1.0), (0.11, 0.0)):
        put_box(base, place_E3 + torch.tensor([0.0, away, 0.0]))
        assert success(base.view).tolist() == [wins] * E
        assert not dropped(base.view).any()
    place_E3[:, 2] = 0.2
    put_box(base, place_E3)
    assert dropped(base.view).all() and not base.cfg.terminations["fallen"](base.view).any()


def test_what_points_to_the_place_turns_with_the_robot(base):
    term = base.cfg.observations["critic"].terms["to_place"].term
    away_E3 = base.view.command("place") - base.view.body(BOX).pos_EL
    matrix_9 = np.zeros(9)
    for row in range(E):
        mujoco.mju_quat2Mat(matrix_9, base.view.robot.root_quat_EL[row].double().numpy())
        seen_3 = matrix_9.reshape(3, 3).T @ away_E3[row].double().numpy()
        np.testing.assert_allclose(term(base.view)[row], seen_3, atol=1e-5)
