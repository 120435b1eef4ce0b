"""Contact sensors on a ball and a box that fall onto the plane: forces and clocks known in closed form.

With timestep h and gravity g MuJoCo's integrator puts a body that starts at rest at z0 - g h^2 k (k + 1) / 2 after k
substeps. The sensors of an env step belong to its last substep, which starts from the state one substep earlier.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from ksim_rl.envs import (
    ContactSensor,
    EnvView,
    ManagerBasedRlEnv,
    ManagerBasedRlEnvCfg,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    PlaneTerrain,
    SceneCfg,
)
from ksim_rl.envs.term import EventTerm
from ksim_rl.mdp import JointEffortAction, JointPos
from ksim_rl.scene.scene import build_spec

SUBSTEP_S, DECIMATION, GRAVITY = 0.002, 10, 10.0
DT = SUBSTEP_S * DECIMATION
FALLING = f"""
<mujoco>
  <option timestep="{SUBSTEP_S}" gravity="0 0 {-GRAVITY}"/>
  <worldbody>
    <body name="ball" pos="0 0 0.1">
      <joint name="ball" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.1" mass="2"/>
    </body>
    <body name="box" pos="1 0 0.1">
      <joint name="box" type="slide" axis="0 0 1"/>
      <geom name="box" type="box" size="0.1 0.1 0.1" mass="3"/>
    </body>
  </worldbody>
  <actuator><motor name="ball" joint="ball"/><motor name="box" joint="box"/></actuator>
</mujoco>
"""
WEIGHT = torch.tensor([2.0, 3.0]) * GRAVITY
"""N, of ball and box."""
HEIGHTS = (0.04, 0.3)
"""m, of each env's ball and box above the plane at the start."""


@dataclass(frozen=True, kw_only=True)
class Drop(EventTerm):
    """Start at rest; env e at `heights[e]` m above the plane."""

    heights: Sequence[float]

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        height_E2 = torch.tensor(self.heights)[:, None].expand(-1, 2)
        view.joints().write_pos(mask_E, height_E2)
        view.joints().write_vel(mask_E, torch.zeros_like(height_E2))


def falling_env(
    heights: Sequence[float] = HEIGHTS,
    geoms=("ball", "box"),
    against="terrain",
    every_substep=False,
) -> ManagerBasedRlEnv:
    group = ObservationGroupCfg(terms={"height": ObservationTermCfg(term=JointPos())})
    touch = ContactSensor(geoms=geoms, against=against, every_substep=every_substep)
    return ManagerBasedRlEnv(
        ManagerBasedRlEnvCfg(
            decimation=DECIMATION,
            scene=SceneCfg(
                robots={"falling": MjcfRobot(source=FALLING)},
                terrain=PlaneTerrain(),
                sensors={"touch": touch},
                num_envs=len(heights),
            ),
            observations={"actor": group},
            actions={"lift": JointEffortAction()},
            events={"drop": Drop(heights=heights)},
            seed=0,
        )
    )


def substeps_in_flight(height: float) -> int:
    """Return the first k after which the body is below the plane."""
    k = 0
    while GRAVITY * SUBSTEP_S**2 * k * (k + 1) / 2 <= height:
        k += 1
    return k


def landing_step(height: float) -> int:
    """Return the env step whose last substep first sees a contact."""
    return -(-(substeps_in_flight(height) + 1) // DECIMATION)


def contacts(env, steps, effort=0.0):
    """Step, and return copies of the contact states after each step."""
    root_E, states = env.reset(), []
    for _ in range(steps):
        root_E = env.step(root_E.set("action", torch.full((env.num_envs, 2), effort)))["next"]
        state = env.view.contact("touch")
        states.append(type(state)(*(leaf.clone() for leaf in state)))
    return states


def test_clocks_follow_the_fall():
    env = falling_env()
    lands = torch.tensor([landing_step(height) for height in HEIGHTS])[:, None].expand(-1, 2)
    assert lands[:, 0].tolist() == [5, 13]
    for n, state in enumerate(contacts(env, 15), start=1):
        flying, followed = n < lands, n <= lands + 2  # later it may bounce

        def check(actual, expected, rows=followed):
            torch.testing.assert_close(actual[rows], expected[rows])

        check(state.found_EN, (~flying).float())
        check(state.air_time_EN, torch.where(flying, n * DT, 0.0))
        check(state.contact_time_EN, torch.where(flying, 0.0, (n - lands + 1) * DT))
        check(state.first_contact_EN, (lands == n).float())
        check(state.last_air_time_EN, torch.where(flying, 0.0, lands * DT))
        assert state.force_EN3[flying].eq(0.0).all()


def test_at_rest_the_force_is_the_weight():
    env = falling_env()
    state = contacts(env, 100)[-1]
    # MuJoCo's sign: the force of the geom on the plane, which points down.
    expected = torch.stack((torch.zeros(2), torch.zeros(2), -WEIGHT), dim=-1).expand(2, 2, 3)
    torch.testing.assert_close(state.force_EN3, expected, atol=0.05, rtol=0)
    assert state.found_EN.eq(1.0).all() and state.first_contact_EN.eq(0.0).all()
    assert state.contact_time_EN.gt(1.0).all() and state.air_time_EN.eq(0.0).all()


def test_a_start_on_the_ground_is_a_contact_but_no_flight():
    state = contacts(falling_env(heights=(0.0, 0.0)), 1)[0]
    assert state.found_EN.eq(1.0).all() and state.first_contact_EN.eq(1.0).all()
    assert state.last_air_time_EN.eq(0.0).all() and state.air_time_EN.eq(0.0).all()
    torch.testing.assert_close(state.contact_time_EN, torch.full((2, 2), DT))


def test_a_lift_takes_weight_off():
    state = contacts(falling_env(heights=(0.0, 0.0)), 100, effort=5.0)[-1]
    torch.testing.assert_close(
        state.force_EN3[..., 2], 5.0 - WEIGHT.expand(2, 2), atol=0.05, rtol=0
    )


def test_what_is_lifted_off_counts_its_flight():
    env = falling_env(heights=(0.0, 0.0))
    contacts(env, 50)
    root_E, lifted = env.reset(), []
    for n in range(1, 9):
        effort_E2 = torch.full((2, 2), 0.0)
        effort_E2[1] = 50.0 if n <= 4 else 0.0  # N: more than the weight, for 80 ms
        root_E = env.step(root_E.set("action", effort_E2))["next"]
        lifted.append(env.view.contact("touch").air_time_EN.clone())
    assert all(air[0].eq(0.0).all() for air in lifted), "env 0 stays on the ground"
    torch.testing.assert_close(lifted[-1][1] - lifted[-2][1], torch.full((2,), DT))
    assert lifted[-1][1].gt(5 * DT).all()


def test_rows_that_reset_read_zero_and_the_others_stay():
    env = falling_env(heights=(0.0, 0.0))
    before = contacts(env, 50)[-1]
    env.reset(env_ids=[1])
    for name, after in env.view.contact("touch")._asdict().items():
        assert after[1].eq(0.0).all(), name
        assert torch.equal(after[0], getattr(before, name)[0]), name
    assert env.view.sensor("touch_ball")[1].eq(0.0).all()


def test_a_lifted_robot_reads_no_contact_after_the_reset():
    # The sensors' own readings would still be from the last substep, in which the bodies lay on the ground.
    env = falling_env(heights=(0.0, 0.0))
    contacts(env, 50)
    root_E = env.reset(env_ids=[0])
    env.world.qpos_EL[0] = 1.0
    env.step(root_E.set("action", torch.zeros(2, 2)))
    state = env.view.contact("touch")
    assert state.found_EN.tolist() == [[0.0, 0.0], [1.0, 1.0]]
    torch.testing.assert_close(state.air_time_EN[0], torch.full((2,), DT))
    assert state.last_air_time_EN[0].eq(0.0).all(), "no flight has ended since the reset"


def test_columns_follow_the_order_of_geoms():
    state = contacts(falling_env(heights=(0.0, 0.0), geoms=("box", "ball")), 100)[-1]
    torch.testing.assert_close(
        state.force_EN3[..., 2], -WEIGHT.flip(0).expand(2, 2), atol=0.05, rtol=0
    )


def test_only_contact_with_the_named_body_counts():
    state = contacts(falling_env(heights=(0.0, 0.0), geoms=("ball",), against="box"), 50)[-1]
    assert (
        state.found_EN.shape == (2, 1)
        and state.found_EN.eq(0.0).all()
        and state.force_EN3.eq(0.0).all()
    )


def test_with_every_substep_the_flight_is_timed_in_substeps():
    env = falling_env(every_substep=True)
    states = contacts(env, 15)
    for n, state in enumerate(states, start=1):
        for row, height in enumerate(HEIGHTS):
            # The sensors of substep k read the state before it.
            first = substeps_in_flight(height) + 1
            flying, lands = n * DECIMATION < first, (n - 1) * DECIMATION < first <= n * DECIMATION
            assert state.first_contact_EN[row].eq(float(lands)).all()
            if flying:
                torch.testing.assert_close(state.air_time_EN[row], torch.full((2,), n * DT))
                assert (
                    state.last_air_time_EN[row].eq(0.0).all()
                    and state.contact_time_EN[row].eq(0.0).all()
                )
            if lands:
                fall = (2 * height / GRAVITY) ** 0.5
                torch.testing.assert_close(
                    state.last_air_time_EN[row], torch.full((2,), fall), atol=2 * SUBSTEP_S, rtol=0
                )
                landed = torch.full((2,), (n * DECIMATION - first + 1) * SUBSTEP_S)
                torch.testing.assert_close(state.contact_time_EN[row], landed)


def test_the_history_holds_the_force_of_each_substep():
    env = falling_env(every_substep=True)
    states = contacts(env, 15)
    history_ESN3 = torch.cat([state.force_history_ESN3 for state in states], dim=1)
    model = env.world.mj_model
    for row, height in enumerate(HEIGHTS):
        data = mujoco.MjData(model)
        data.qpos[:] = height
        expected = []
        for _ in range(15 * DECIMATION):
            mujoco.mj_step(model, data)
            expected.append(
                np.stack([data.sensor("touch_ball").data[1:4], data.sensor("touch_box").data[1:4]])
            )
        expected_SN3 = np.stack(expected)
        assert np.abs(expected_SN3).max() > 100.0, "an impact"
        np.testing.assert_allclose(history_ESN3[row], expected_SN3, atol=0.5, rtol=2e-3)
    assert torch.equal(history_ESN3[:, -1], states[-1].force_EN3)
    env.reset(env_ids=[0])
    history_ESN3 = env.view.contact("touch").force_history_ESN3
    assert history_ESN3[0].eq(0.0).all() and history_ESN3[1].ne(0.0).any()


def test_without_it_the_history_is_the_last_substep_and_the_graph_stays_one():
    env = falling_env(heights=(0.0, 0.0))
    state = contacts(env, 5)[-1]
    assert torch.equal(state.force_history_ESN3, state.force_EN3[:, None])
    assert env.driver.after_substep == [] and env.driver.substep_sensors == "last"


def test_last_contact_time_and_first_air_mark_the_take_off():
    env = falling_env(heights=(0.0, 0.0))
    root_E, taken_off = env.reset(), []
    for n in range(1, 21):
        effort_E2 = torch.full((2, 2), 0.0 if n <= 10 else 50.0)
        root_E = env.step(root_E.set("action", effort_E2))["next"]
        state = env.view.contact("touch")
        taken_off.append(state.first_air_EN[0, 0].item())
    assert sum(taken_off) == 1.0
    # Up to the env step that sees it in the air, as the flight is counted up to the one that sees the landing.
    stood = (taken_off.index(1.0) + 1) * DT
    torch.testing.assert_close(state.last_contact_time_EN, torch.full((2, 2), stood))


class PlainClock:
    """The clocks of one foot in plain Python, as mjlab 1.6.0 keeps them per physics step: float32 sums of `dt`."""

    def __init__(self) -> None:
        zero = np.float32(0.0)
        self.air_time = self.last_air_time = self.contact_time = self.last_contact_time = zero

    def advance(self, touches: bool, dt: float) -> None:
        """Let one physics step pass, in which the foot touches or not."""
        flight = np.float32(self.air_time + np.float32(dt))
        stance = np.float32(self.contact_time + np.float32(dt))
        if touches:
            if self.air_time > 0:
                self.last_air_time = flight
            self.air_time, self.contact_time = np.float32(0.0), stance
        else:
            if self.contact_time > 0:
                self.last_contact_time = stance
            self.air_time, self.contact_time = flight, np.float32(0.0)

    def landed(self, step_dt: float) -> bool:
        """Whether it stands, and has for no longer than one env step, with mjlab's tolerance of 1e-6 s."""
        return 0.0 < self.contact_time < step_dt + 1e-6


def test_clocks_of_any_sequence_of_substeps_are_those_of_plain_python_to_the_last_bit():
    # Feet that bounce within env steps, stand, fly, and begin in the air or on the ground.
    draws = np.random.default_rng(7)
    touches_TEN = draws.random((40, DECIMATION, 2, 2)) < np.array([[0.9, 0.5], [0.1, 0.97]])
    touches_TEN[:12, :, 1, 1] = False
    env = falling_env(every_substep=True)
    env.reset()
    tracker = env.view.sensors["touch"]
    adr = [int(env.world.mj_model.sensor(f"touch_{name}").adr[0]) for name in ("ball", "box")]
    clocks = [[PlainClock(), PlainClock()] for _ in range(2)]
    seen = {"landed": 0, "bounced off": 0}
    for touches_SEN in touches_TEN:
        before = [[clock.contact_time > 0 for clock in row] for row in clocks]
        for touches_EN in touches_SEN:
            env.world.sensordata_EL[:, adr] = torch.from_numpy(touches_EN).float()
            tracker.update_substep()
            for row, clocks_N in enumerate(clocks):
                for foot, clock in enumerate(clocks_N):
                    clock.advance(bool(touches_EN[row, foot]), SUBSTEP_S)
        env.driver.changed()
        env.driver.refreshed()
        state = env.view.contact("touch")
        for name in ("air_time", "last_air_time", "contact_time", "last_contact_time"):
            expected = [[getattr(clock, name) for clock in row] for row in clocks]
            assert getattr(state, f"{name}_EN").tolist() == expected, name
        landed = [[clock.landed(DT) for clock in row] for row in clocks]
        assert (state.first_contact_EN > 0).tolist() == landed
        seen["landed"] += int(np.sum(landed))
        touched = touches_SEN.any(0) & ~np.array(before)
        seen["bounced off"] += int((touched & ~np.array(landed)).sum())
    # Both occur: landings, and touches within an env step after which the foot is in the air again.
    assert min(seen.values()) > 10


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (
            ContactSensor(geoms=("ball", "bx")),
            r"scene\.sensors\.feet: no geom matches 'bx': did you mean 'box'",
        ),
        (
            ContactSensor(geoms=("ball",), against="terain"),
            r"no body 'terain': did you mean 'terrain'",
        ),
    ],
)
def test_unknown_geoms_and_bodies_are_refused(sensor, message):
    robots = {"falling": MjcfRobot(source=FALLING)}
    with pytest.raises(ValueError, match=message):
        build_spec(SceneCfg(robots=robots, terrain=PlaneTerrain(), sensors={"feet": sensor}))


@pytest.mark.parametrize("given", [{}, {"geoms": ("ball",), "bodies": ("ball",)}])
def test_a_sensor_needs_one_kind_of_element(given):
    with pytest.raises(
        ValueError, match=r"geoms=.*, bodies=.*, subtrees=.*: give exactly one of them"
    ):
        ContactSensor(**given)
