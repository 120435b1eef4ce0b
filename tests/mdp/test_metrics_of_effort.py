"""Power and cost of transport of a cart on a rail, in closed form."""

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.envs import MjcfRobot, SceneCfg
from tests.envs.probe_env import DT, PUCK_XML, Launch, puck_env_in_c
from tests.mdp.bench import FREE_BODY, Bench

CART = PUCK_XML.replace('gravity="0 0 0"', 'gravity="0 0 -5"').replace(
    '<motor name="push" joint="rail"/>', '<motor name="push" joint="rail" gear="2"/>'
)


@pytest.fixture
def cart():
    return Bench(CART, 2, {})


def test_power_is_force_times_speed_and_braking_counts(cart):
    cart.place(qpos=(0.0,), qvel=[(3.0,), (-3.0,)])
    cart.world.ctrl_EL.fill_(2.0)
    cart.step(1)
    # 4 N (behind the gear) on 1 kg for 5 ms: 3.02 m/s and -2.98 m/s.
    power_E = cart.read(mdp.Power(), "metrics/x")
    torch.testing.assert_close(power_E, torch.tensor([4.0 * 3.02, 4.0 * 2.98]))


def test_power_is_of_the_named_joints(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0.5), qvel=(0, 0, 0, 0, 0, 0, 2.0, 3.0))
    free_body.world.qfrc_actuator_EL[:, 6:] = torch.tensor([5.0, -7.0])
    assert free_body.read(mdp.Power(joints="left_hip"), "metrics/x").tolist() == [10.0] * 3
    assert free_body.read(mdp.Power(), "metrics/x").tolist() == [31.0] * 3


def test_cost_of_transport_is_energy_per_weight_and_way(cart):
    metric, energy, way = mdp.CostOfTransport(), 0.0, 0.0
    cart.place(qpos=(0.0,), qvel=(1.0,))
    cart.world.ctrl_EL.fill_(0.5)
    for _ in range(30):
        cart.step(4)
        speed = float(cart.world.qvel_EL[0, 0])
        energy, way = energy + 1.0 * speed * 0.02, way + speed * 0.02
        value_E = cart.read(metric, "metrics/x")
        assert float(value_E[0]) == pytest.approx(energy / (5.0 * max(way, 0.1)), rel=1e-5)
    assert way > 0.6 and float(value_E[0]) == pytest.approx(0.2, rel=1e-5), (
        "1 N of force over 5 N of weight"
    )


def test_standing_still_has_a_finite_cost_and_a_reset_starts_anew():
    env = puck_env_in_c(
        limit=None,
        events={"launch": Launch(speed=0.0)},
        episode_length_s=3 * DT,
        scene=SceneCfg(robots={"cart": MjcfRobot(source=CART)}, num_envs=3),
        metrics={"cost": mdp.CostOfTransport(), "power": mdp.Power(reduce="sum")},
    )
    root_E = env.reset()
    for _ in range(2):
        for _ in range(3):
            env_state_E, root_E = env.step_and_maybe_reset(
                root_E.set("action", torch.full((3, 1), 1.0))
            )
        assert env_state_E["next", "done"].all()
    log = env.episode_log()
    # Speeds 0.04, 0.08, 0.12 m/s under 2 N: 0.48 W in sum, so 0.0096 J on 5 N over the least way of 0.1 m.
    assert log["episodes"] == 6
    assert float(log["metric/power"]) / 6 == pytest.approx(0.48, rel=1e-5)
    assert float(log["metric/cost"]) / 6 == pytest.approx(0.0096 / (5.0 * 0.1), rel=1e-5)


def test_without_weight_there_is_no_cost_of_transport(make_bench):
    bench = make_bench(FREE_BODY.replace('timestep="0.002"', 'timestep="0.002" gravity="0 0 0"'), 2)
    with pytest.raises(ValueError, match="CostOfTransport without gravity"):
        bench.read(mdp.CostOfTransport(), "metrics/x")


def test_a_least_way_of_zero_is_refused():
    with pytest.raises(ValueError, match=r"min_distance=0\.0"):
        mdp.CostOfTransport(min_distance=0.0)
