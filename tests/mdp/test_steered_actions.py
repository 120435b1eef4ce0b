"""Position targets that actions move: where they are after some env steps of 20 ms, in closed form."""

import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import Bench
from tests.mdp.test_actions import ARMS, ELBOW, SHOULDER

DT = 0.02
JOINTS = ("shoulder", "elbow")


@pytest.fixture
def arms():
    """Three arms that start at 0.1 and 0.2 rad, not at the default pose."""
    bench = Bench(ARMS, 3, {})
    bench.place(qpos=(0.1, 0.2, 0, 0, 0))
    return bench


def steps(bench, term, actions):
    """Return the targets of shoulder and elbow after each action, [steps, E, 2]."""
    seen = []
    for action in actions:
        with bench.driver.scope("actions/x"):
            term(bench.view, torch.tensor(action).expand(3, 2))
        seen.append(bench.world.ctrl_EL[:, [SHOULDER, ELBOW]].clone())
    return torch.stack(seen)


def same(actual_TEK, expected):
    expected_TEK = torch.tensor(expected)[:, None].expand_as(actual_TEK)
    torch.testing.assert_close(actual_TEK, expected_TEK, atol=1e-6, rtol=0)


def test_a_velocity_adds_up_from_where_the_joints_are(arms):
    term = mdp.IntegratedVelocityAction(joints=JOINTS, scale=2.0)
    seen = steps(arms, term, [[1.0, 0.0], [1.0, -0.5], [0.0, 0.0]])
    same(seen, [[0.1 + 2 * DT, 0.2], [0.1 + 4 * DT, 0.2 - DT], [0.1 + 4 * DT, 0.2 - DT]])
    assert torch.equal(arms.view.joint_pos_target_EL[:, :2], seen[-1])


def test_a_reset_row_starts_where_its_joints_are_and_the_others_go_on(arms):
    term = mdp.IntegratedVelocityAction(joints=JOINTS)
    steps(arms, term, [[1.0, 1.0]])
    arms.view.buffers.clear(torch.tensor([False, True, False]))
    arms.place(qpos=(-0.3, 0.5, 0, 0, 0))
    after = steps(arms, term, [[1.0, 1.0]])[0]
    going_on = [0.1 + 2 * DT, 0.2 + 2 * DT]
    torch.testing.assert_close(after, torch.tensor([going_on, [-0.3 + DT, 0.5 + DT], going_on]))


def test_an_acceleration_adds_up_twice_within_the_greatest_velocity(arms):
    term = mdp.IntegratedAccelerationAction(joints=JOINTS, max_velocity=0.3)
    seen = steps(arms, term, [[10.0, 0.0], [10.0, -5.0], [0.0, 0.0]])
    # Velocities of the shoulder: 0.2, then 0.3 (and not 0.4); of the elbow: 0, then -0.1.
    same(
        seen,
        [
            [0.1 + 0.2 * DT, 0.2],
            [0.1 + 0.5 * DT, 0.2 - 0.1 * DT],
            [0.1 + 0.8 * DT, 0.2 - 0.2 * DT],
        ],
    )


def test_a_target_approaches_a_position_within_the_greatest_acceleration(arms):
    term = mdp.BoundedAccelerationAction(
        joints=JOINTS, use_default_offset=False, max_acceleration=50.0
    )
    seen = steps(arms, term, [[1.0, 0.21]] * 3)
    # 50 rad/s^2 are 1 rad/s more in each step; 0.01 rad in 0.02 s need only 0.5 rad/s, and as much to stop.
    same(seen, [[0.1 + 1 * DT, 0.21], [0.1 + 3 * DT, 0.21], [0.1 + 6 * DT, 0.21]])
    # Without a bound that matters it is the position itself, offset included.
    plain = mdp.JointPositionAction(joints=JOINTS, scale=0.5)
    free = mdp.BoundedAccelerationAction(joints=JOINTS, scale=0.5, max_acceleration=1e9)
    torch.testing.assert_close(
        steps(arms, free, [[1.0, -1.0]]), steps(arms, plain, [[1.0, -1.0]]), atol=1e-5, rtol=0
    )


LIMITED = ARMS.replace(
    '<joint name="shoulder"', '<joint name="shoulder" limited="true" range="-1 0.15"'
)


def test_a_target_stops_at_the_soft_limit_and_comes_back_at_once():
    bench = Bench(LIMITED, 3, {})
    bench.place(qpos=(0.1, 0.2, 0, 0, 0))
    term = mdp.IntegratedAccelerationAction(joints=JOINTS)
    seen = steps(bench, term, [[100.0, 0.0], [100.0, 0.0], [-100.0, 0.0]])[:, 0, 0]
    # 2 rad/s, then 4 rad/s into the limit, where it stands; -2 rad/s from there.
    torch.testing.assert_close(
        seen, torch.tensor([0.1 + 2 * DT, 0.15, 0.15 - 2 * DT]), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        (mdp.IntegratedAccelerationAction, "max_velocity"),
        (mdp.BoundedAccelerationAction, "max_acceleration"),
    ],
)
def test_bounds_are_positive(kind, field):
    with pytest.raises(ValueError, match=f"{field}=0"):
        kind(joints=JOINTS, **{field: 0.0})
