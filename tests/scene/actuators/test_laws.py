"""Motor models where the answer is known in closed form."""

import pytest
import torch

from ksim_rl.scene.actuators import (
    DCMotorActuator,
    DelayedActuator,
    IdealPDActuator,
    JointDrives,
    PositionActuator,
)
from tests.scene.actuators.chain import JOINTS, ChainBench

STALL, NO_LOAD, LIMIT = 10.0, 8.0, 7.0
STIFF = {"stiffness": 1e4, "damping": 0.0}
"""So stiff that any error asks for all that the motor has."""


@pytest.fixture(scope="module")
def pd():
    return ChainBench(
        IdealPDActuator(joints="knee", stiffness=3.0, damping=0.5, effort_limit=LIMIT),
        IdealPDActuator(joints=("ankle", "hip"), stiffness=4.0, damping=0.0),
    )


def test_pd_effort_is_the_sum_of_three_errors(pd):
    pd.move("knee", pos=0.4, vel=[1.0, -2.0, 0.0])
    pd.view.write_joint_pos_target("knee", torch.tensor([[1.0], [0.4], [0.0]]))
    pd.view.write_joint_vel_target("knee", torch.tensor([[0.0], [1.0], [2.0]]))
    pd.view.write_joint_effort_target("knee", torch.tensor([[0.0], [0.0], [0.3]]))
    expected = [3.0 * 0.6 - 0.5, 0.5 * 3.0, -3.0 * 0.4 + 0.5 * 2.0 + 0.3]
    torch.testing.assert_close(pd.efforts("knee"), torch.tensor(expected))


def test_pd_effort_stops_at_its_limit_and_only_there(pd):
    pd.move("knee", pos=0.0, vel=0.0)
    pd.view.write_joint_effort_target("knee", torch.zeros(3, 1))
    pd.view.write_joint_vel_target("knee", torch.zeros(3, 1))
    pd.view.write_joint_pos_target("knee", torch.tensor([[100.0], [-100.0], [2.0]]))
    assert pd.efforts("knee").tolist() == [LIMIT, -LIMIT, 6.0]
    pd.move("hip", pos=0.0)
    pd.view.write_joint_pos_target("hip", torch.tensor([[1e6], [0.0], [0.0]]))
    assert pd.efforts("hip")[0] == 4e6, "no limit was given"


def test_each_world_may_have_its_own_numbers(pd):
    pd.move("knee", pos=0.0, vel=0.0)
    pd.view.write_joint_pos_target("knee", torch.full((3, 1), 1.0))
    knee = JOINTS.index("knee")
    stiffness_EL = pd.view.actuator_param("stiffness", "knee")
    torch.testing.assert_close(
        pd.view.actuator_params.nominal("stiffness"), torch.tensor([4.0, 3.0, 4.0, 0.0, 0.0, 0.0])
    )
    stiffness_EL[:, knee] = torch.tensor([1.0, 2.0, 3.0])
    pd.view.actuator_param("effort_limit")[:, knee] = torch.tensor([9.0, 9.0, 0.5])
    assert pd.efforts("knee").tolist() == [1.0, 2.0, 0.5]
    pd.reset(0, 1, 2)
    assert stiffness_EL[:, knee].tolist() == [1.0, 2.0, 3.0], "a reset leaves it alone"
    stiffness_EL[:, knee] = 3.0
    pd.view.actuator_param("effort_limit")[:, knee] = LIMIT


def test_a_number_that_a_joint_does_not_have_is_refused(pd):
    with pytest.raises(ValueError, match="'stifness'.*'stiffness'"):
        pd.view.actuator_param("stifness")
    with pytest.raises(
        ValueError, match="joint 'neck' has no parameter 'stiffness'.*actuator_gainprm"
    ):
        pd.view.actuator_param("stiffness", ("knee", "neck"))


@pytest.fixture(scope="module")
def dc():
    return ChainBench(
        DCMotorActuator(
            joints="knee",
            effort_limit=LIMIT,
            saturation_effort=STALL,
            velocity_limit=NO_LOAD,
            **STIFF,
        ),
        num_envs=7,
    )


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_torque_falls_along_the_speed_torque_line(dc, direction):
    """Forward effort: the current limit at stall, half at half speed, none at no load, braking beyond."""
    speeds = torch.tensor([0.0, 0.25, 0.5, 1.0, 1.5, -0.5, -3.0]) * NO_LOAD
    dc.move("knee", pos=0.0, vel=direction * speeds)
    dc.view.write_joint_pos_target("knee", torch.full((7, 1), direction))
    expected = [LIMIT, LIMIT, STALL / 2, 0.0, -STALL / 2, LIMIT, LIMIT]
    torch.testing.assert_close(
        dc.efforts("knee"), direction * torch.tensor(expected), atol=1e-5, rtol=0.0
    )


def test_braking_has_the_whole_current(dc):
    dc.move(
        "knee",
        pos=0.0,
        vel=[NO_LOAD, 2 * NO_LOAD, 0.5 * NO_LOAD, 0.0, -NO_LOAD, -9.0 * NO_LOAD, 0.1],
    )
    dc.view.write_joint_pos_target("knee", torch.full((7, 1), -1.0))
    expected = [-LIMIT, -LIMIT, -LIMIT, -LIMIT, 0.0, LIMIT, -LIMIT]
    torch.testing.assert_close(dc.efforts("knee"), torch.tensor(expected), atol=1e-5, rtol=0.0)


@pytest.fixture(scope="module")
def late():
    pd = IdealPDActuator(joints="knee", stiffness=1.0, damping=0.0)
    servo = PositionActuator(joints="neck", stiffness=5.0)
    return ChainBench(
        DelayedActuator(actuator=pd, min_lag=2, max_lag=4),
        DelayedActuator(actuator=servo, min_lag=3, max_lag=3),
        num_envs=64,
    )


def lags(bench, number):
    return bench.view.buffers.by_name()[f"actuators/{number}.lag_E"]


def test_lags_are_drawn_from_the_whole_range_and_from_nothing_else(late):
    late.reset(*range(64))
    assert sorted(set(lags(late, 0).tolist())) == [2, 3, 4]
    assert set(lags(late, 1).tolist()) == {3}


def test_a_signal_arrives_shifted_by_exactly_the_lag_of_its_row(late):
    late.reset(*range(64))
    late.move("knee", pos=0.0, vel=0.0)
    signal = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0]
    arrived = []
    for value in signal:
        late.view.write_joint_pos_target("knee", torch.full((64, 1), value))
        late.view.write_joint_pos_target("neck", torch.full((64, 1), -value))
        arrived.append((late.efforts("knee"), late.world.ctrl_EL[:, 1].clone()))
    for row, lag in enumerate(lags(late, 0).tolist()):
        expected = [signal[max(0, substep - lag)] for substep in range(len(signal))]
        assert [knee[row].item() for knee, _ in arrived] == expected, (
            "the first target counts as older, too"
        )
    assert [neck[0].item() for _, neck in arrived] == [
        -signal[max(0, k - 3)] for k in range(len(signal))
    ]


def test_a_row_that_resets_sees_its_own_first_target_and_the_others_go_on(late):
    late.reset(*range(64))
    late.move("knee", pos=0.0, vel=0.0)
    for value in (1.0, 2.0, 3.0, 4.0, 5.0):
        late.view.write_joint_pos_target("knee", torch.full((64, 1), value))
        late.efforts("knee")
    before = lags(late, 0).clone()
    late.reset(7)
    assert torch.equal(lags(late, 0)[torch.arange(64) != 7], before[torch.arange(64) != 7])
    late.view.write_joint_pos_target("knee", torch.full((64, 1), 9.0))
    efforts = late.efforts("knee")
    assert efforts[7] == 9.0
    expected = torch.tensor([5.0 - (lag - 1) for lag in before.tolist()])
    assert torch.equal(efforts[torch.arange(64) != 7], expected[torch.arange(64) != 7])


def test_draws_depend_on_row_and_count_of_resets_only(late):
    late.reset(*range(64))
    counts = late.view.reset_count_E.clone()
    first = lags(late, 0).clone()
    late.reset(*range(0, 64, 2))
    again = ChainBench(
        DelayedActuator(
            actuator=IdealPDActuator(joints="knee", stiffness=1.0, damping=0.0),
            min_lag=2,
            max_lag=4,
        ),
        num_envs=64,
    )
    again.view.reset_count_E.copy_(counts - 1)
    again.reset(*range(64))
    assert torch.equal(lags(again, 0), first)


def test_entries_of_a_group_have_one_lag():
    pd = {"stiffness": 1.0, "damping": 0.0}

    def chain(*groups, bounds=((0, 5), (0, 5))):
        joints = ("knee", "neck")
        return ChainBench(
            *(
                DelayedActuator(
                    actuator=IdealPDActuator(joints=joint, **pd),
                    min_lag=low,
                    max_lag=high,
                    lag_group=group,
                )
                for joint, group, (low, high) in zip(joints, groups, bounds, strict=True)
            ),
            num_envs=64,
        )

    together, apart = chain("bus", "bus"), chain("left", "right")
    for _ in range(2):
        together.reset(*range(64))
        assert (
            torch.equal(lags(together, 0), lags(together, 1))
            and len(set(lags(together, 0).tolist())) == 6
        )
    assert not torch.equal(lags(apart, 0), lags(apart, 1))
    with pytest.raises(ValueError, match="lag_group='bus': lags from 0 to 5 and from 1 to 5"):
        chain("bus", "bus", bounds=((0, 5), (1, 5)))


def test_a_robot_that_forgot_to_set_its_actuators_is_told(pd):
    entry = IdealPDActuator(joints="neck", stiffness=1.0, damping=0.0)
    with pytest.raises(ValueError, match="'neck' has 0 actuators.*set_actuators"):
        JointDrives({"": (entry,)}, pd.driver, pd.view)
