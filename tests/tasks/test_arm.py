"""The arm and its cube: two entities in one env."""

import math

import pytest
import torch

from ksim_rl import mdp
from tests.tasks.placed import Placed

E = 3


@pytest.fixture(scope="module")
def bench():
    return Placed("arm_push", E)


def hold(bench, **targets):
    """Let the servos hold the default pose, but for some joints, for half a second."""
    bench.world.ctrl_EL.copy_(bench.view.default_joint_pos_EL)
    for name, value in targets.items():
        bench.world.ctrl_EL[:, bench.view.resolver.index("actuator", f"arm/{name}")] = torch.tensor(
            value
        )[:, None]
    for _ in range(10):
        bench.world.step(10)
    bench.world.refresh()
    bench.driver.refreshed()


def test_the_arm_carries_its_weight_and_points_down(bench):
    bench.set({})
    hold(bench)
    tip = bench.view.sites("arm/tip").pos_EN3[:, 0]
    torch.testing.assert_close(
        bench.view.entity("arm").joints.pos_EL, bench.view.default_joint_pos_EL, atol=1e-3, rtol=0.0
    )
    wrist = bench.view.bodies("arm/hand").pos_EN3[:, 0]
    assert (wrist[:, 2] - tip[:, 2] > 0.99 * 0.142).all(), (
        "the pusher hangs from the wrist, 0.142 m long"
    )


def test_the_cube_rests_on_the_table_until_it_is_pushed(bench):
    cube = bench.view.entity("cube")
    bench.set({})
    hold(bench)
    pos = cube.root_pos_EL.clone()
    torch.testing.assert_close(
        pos, torch.tensor([[0.35, 0.0, 0.03]]).expand(E, 3), atol=2e-3, rtol=0.0
    )
    # The pusher beside the cube, low; then each env turns the arm another way: toward it, not at all, away.
    low = {"arm/yaw": 0.4, "arm/shoulder": 0.8, "arm/elbow": 1.55, "arm/wrist": 0.75}
    bench.set(low)
    tip = bench.view.sites("arm/tip").pos_EN3[0, 0]
    assert 0.01 < tip[2] < 0.06 and abs(tip[:2].norm() - 0.35) < 0.06, tip
    still = {"shoulder": [0.8] * E, "elbow": [1.55] * E, "wrist": [0.75] * E}
    hold(bench, yaw=[-0.3, 0.4, 0.8], **still)
    moved = cube.root_pos_EL - pos
    assert moved[0, 1] < -0.02, "pushed to the right"
    assert moved[1:, :2].abs().max() < 2e-3, "left alone"


def test_terms_name_their_entity(bench):
    bench.set({})
    view = bench.view
    bench.driver.readings.commands["target"] = torch.tensor([[0.35, 0.1, 0.03]] * E)
    assert bench.reward(
        mdp.TrackPosition(command="target", body="cube/box", std=0.1)
    ).tolist() == pytest.approx([math.exp(-1.0)] * E, abs=1e-4)
    offset = bench.reward(mdp.OffsetToCommand(command="target", body="cube/box"))
    torch.testing.assert_close(
        offset, torch.tensor([[0.0, 0.1, 0.0]]).expand(E, 3), atol=1e-6, rtol=0.0
    )
    tip = view.sites("arm/tip").pos_EN3[:, 0]
    to_cube = bench.reward(mdp.OffsetToBody(site="arm/tip", body="cube/box"))
    torch.testing.assert_close(to_cube, torch.tensor([[0.35, 0.0, 0.03]]) - tip)
    near = bench.reward(mdp.NearBody(site="arm/tip", body="cube/box", std=0.2))
    torch.testing.assert_close(near, torch.exp(-(to_cube / 0.2).square().sum(-1)))


def test_a_partial_reset_moves_the_cubes_of_its_rows_only(bench):
    env, world = bench.env, bench.world
    env.reset()
    qpos = world.qpos_EL.clone()
    env.reset(env_ids=torch.tensor([1]))
    assert torch.equal(world.qpos_EL[[0, 2]], qpos[[0, 2]])
    assert not torch.equal(
        bench.view.entity("cube").root_pos_EL[1], qpos[1, bench.view.entity("cube").root_qpos][:3]
    )
    for row in world.qpos_EL[:, bench.view.entity("cube").root_qpos]:
        assert (
            0.28 <= row[0] <= 0.40
            and abs(row[1]) <= 0.12
            and row[2] == pytest.approx(0.03, abs=1e-6)
        )


def test_one_of_body_and_site_is_named():
    with pytest.raises(ValueError, match="name exactly one of the two"):
        mdp.OffsetToCommand(command="target")
    with pytest.raises(ValueError, match=r"std=0\.0"):
        mdp.NearBody(site="tip", body="box", std=0.0)
