import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.sensors import ContactSensor
from tests.mdp.bench import BOXES, Plateau

MOVING, IDLE = [0.3, 0.0, 0.0], [0.0, 0.04, 0.0]
GATE = {"command": "twist", "command_threshold": 0.05}


def boxes_at(*heights):
    """Positions of boxes "a" and "b" whose undersides are at these heights."""
    low, high = heights
    return (0, 0, 0.1 + low, 1, 0, 0, 0, 1, 0, 0.1 + high, 1, 0, 0, 0)


def test_clearance_weighs_the_height_error_by_the_horizontal_speed(free_body):
    # Each hip turns its foot, 0.4 m below, at 0.4 |rate| m/s; the height is 0.55 - 0.4.
    free_body.place(qpos=(0, 0, 0.55, 1, 0, 0, 0, 0, 0), qvel=(0, 0, 0, 0, 0, 0, 2.0, -1.0))
    free_body.command([MOVING, IDLE, [0.0, 0.0, -0.06]])
    term = mdp.FootClearance(sites=("left_foot", "right_foot"), target_height=0.1, **GATE)
    value = free_body.read(term, "rewards/x")
    torch.testing.assert_close(
        value, 0.05 * (0.8 + 0.4) * torch.tensor([1.0, 0.0, 1.0]), atol=1e-5, rtol=0
    )


def test_clearance_ignores_vertical_motion(free_body):
    free_body.place(qpos=(0, 0, 0.8, 1, 0, 0, 0, 0, 0), qvel=(0, 0, 3, 0, 0, 0, 0, 0))
    free_body.command(MOVING)
    term = mdp.FootClearance(sites=(".*_foot",), target_height=0.1, **GATE)
    torch.testing.assert_close(free_body.read(term, "rewards/x"), torch.zeros(3), atol=1e-5, rtol=0)


def slips_of_c(model, heights, *, steps):
    """Return, per env step of 10 substeps, sum_f contact_f |v_xy,f|^2 as MuJoCo's C engine leaves the last substep."""
    data, velocity_6, slips = mujoco.MjData(model), np.zeros(6), []
    data.qpos[:] = boxes_at(*heights)
    data.qvel[:] = SLIDING
    for _ in range(steps):
        slips.append(0.0)
        for _ in range(10):
            mujoco.mj_step(model, data)
        # `mj_step` integrates last: contacts and velocities of frames are both of the state before that.
        for name in ("a", "b"):
            mujoco.mj_objectVelocity(
                model, data, mujoco.mjtObj.mjOBJ_SITE, model.site(name).id, velocity_6, False
            )
            slips[-1] += (data.sensor(f"touch_{name}").data[0] > 0) * float(
                np.square(velocity_6[3:5]).sum()
            )
    return slips


SLIDING = (3, 4, 0, 0, 0, 0, 3, 4, 0, 0, 0, 0)


def test_slip_pairs_contact_and_velocity_of_one_moment(boxes):
    # Box a is 7 mm up: it lands in the last substep of the second step, whose end has taken much of its speed.
    heights, term = (0.007, 0.5), mdp.FootSlip(sensor="touch", sites=("a", "b"), **GATE)
    boxes.command([MOVING, IDLE])
    boxes.read(term, "rewards/x")
    boxes.place(qpos=boxes_at(*heights), qvel=SLIDING)
    found, at_the_end = [], []
    for _ in range(4):
        boxes.step()
        found.append(boxes.read(term, "rewards/x").tolist())
        at_the_end.append(float(boxes.view.sites("a").lin_vel_EN3[0, 0, :2].square().sum()))
    expected = slips_of_c(boxes.world.mj_model, heights, steps=4)
    np.testing.assert_allclose(found, [[slip, 0.0] for slip in expected], rtol=2e-3, atol=1e-5)
    # The speed at the end of that step would be another number.
    assert expected[0] == 0.0 and expected[1] > 1.1 * at_the_end[1] > 0.0


def test_slip_forgets_at_a_reset(boxes):
    term = mdp.FootSlip(sensor="touch", sites=("a", "b"), **GATE)
    boxes.command(MOVING)
    boxes.read(term, "rewards/x")
    boxes.place(qpos=boxes_at(-0.001, -0.001), qvel=SLIDING)
    boxes.step(1)
    assert boxes.read(term, "rewards/x").gt(0.0).all()
    boxes.view.buffers.clear(torch.tensor([True, False]))
    assert boxes.view.sites("a").lin_vel_of_contacts_EN3[0].eq(0.0).all()
    assert boxes.read(term, "rewards/x")[1] > 0.0


@pytest.mark.parametrize(
    "term",
    [
        mdp.FootSlip(sensor="any", sites=("a", "b"), **GATE),
        mdp.FootSwingHeight(sensor="any", sites=("a", "b"), target_height=0.2, **GATE),
        mdp.FootSlipSpeed(sensor="any", sites=("a", "b")),
    ],
    ids=lambda term: type(term).__name__,
)
def test_one_contact_does_not_stand_for_all_feet(make_bench, term):
    bench = make_bench(BOXES, 2, {"any": ContactSensor(geoms=("a",))})
    bench.command(MOVING)
    with pytest.raises(
        ValueError, match=r"rewards\.x: sensor='any' has 1 elements, and sites=\('a', 'b'\) are 2"
    ):
        bench.read(term, "rewards/x")


def test_swing_height_is_paid_at_landing_and_starts_anew(boxes):
    term = mdp.FootSwingHeight(sensor="touch", sites=("a", "b"), target_height=0.2, **GATE)
    boxes.command([MOVING, IDLE])

    def read():
        return boxes.read(term, "rewards/swing")

    boxes.place(qpos=boxes_at(0.0, 0.0))
    boxes.step()
    # The first contact of an episode ends a swing whose peak is still 0.
    torch.testing.assert_close(read(), torch.tensor([2.0, 0.0]))
    boxes.step()
    torch.testing.assert_close(read(), torch.zeros(2))

    heights = []
    for underside in (0.1, 0.3, 0.15):
        boxes.place(qpos=boxes_at(0.0, underside), qvel=torch.zeros(12))
        boxes.step()
        heights.append(float(boxes.world.site_xpos_EL[0, 1, 2]))
        torch.testing.assert_close(read(), torch.zeros(2))
    assert max(heights) == heights[1]
    boxes.place(qpos=boxes_at(0.0, 0.0), qvel=torch.zeros(12))
    boxes.step()
    paid = (max(heights) / 0.2 - 1.0) ** 2
    torch.testing.assert_close(read(), torch.tensor([paid, 0.0]), atol=1e-5, rtol=0)

    boxes.place(qpos=boxes_at(0.0, 0.05), qvel=torch.zeros(12))
    boxes.step()
    read()
    lower = float(boxes.world.site_xpos_EL[0, 1, 2])
    boxes.place(qpos=boxes_at(0.0, 0.0), qvel=torch.zeros(12))
    boxes.step()
    torch.testing.assert_close(
        read(), torch.tensor([(lower / 0.2 - 1.0) ** 2, 0.0]), atol=1e-5, rtol=0
    )


def test_swing_height_forgets_at_a_reset(boxes):
    term = mdp.FootSwingHeight(sensor="touch", sites=("a", "b"), target_height=0.2, **GATE)
    boxes.command(MOVING)
    boxes.place(qpos=boxes_at(0.4, 0.4))
    boxes.step()
    boxes.read(term, "rewards/swing")
    boxes.view.buffers.clear(torch.tensor([True, False]))
    boxes.place(qpos=boxes_at(0.0, 0.0), qvel=torch.zeros(12))
    boxes.step()
    value = boxes.read(term, "rewards/swing")
    assert value[0] == pytest.approx(2.0)
    assert value[1] > 2.0


def test_the_highest_swing_earns_its_height_at_landing(boxes):
    term = mdp.FootSwingPeak(sensor="touch", sites=("a", "b"), target_height=0.25, **GATE)
    boxes.command([MOVING, IDLE])
    earned = []
    for low, high in ((0.0, 0.0), (0.02, 0.1), (0.0, 0.0), (0.0, 0.6), (0.0, 0.0), (0.0, 0.0)):
        boxes.place(qpos=boxes_at(low, high), qvel=torch.zeros(12))
        boxes.step()
        height = float(boxes.world.site_xpos_EL[0, 1, 2])
        earned.append((boxes.read(term, "rewards/swing").tolist(), height))
    values = [value for value, _ in earned]
    # Paid where the swing ends, for its peak, 0.25 m at most; box a swings lower, at the same time.
    assert values[0] == values[1] == values[3] == values[5] == [0.0, 0.0]
    assert values[2] == [pytest.approx(earned[1][1], abs=1e-6), 0.0]
    assert values[4] == [pytest.approx(0.25), 0.0]


def test_feet_are_too_close_if_any_two_are(make_bench):
    bodies = "".join(
        f'<body name="{name}" pos="0 {y} 0"><joint name="{name}" type="slide" axis="0 1 0"/>'
        f'<geom size="0.01"/><site name="{name}"/></body>'
        for name, y in (("a", 0), ("b", 1), ("c", 2))
    )
    bench = make_bench(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>", 3)
    term = mdp.FeetTooClose(sites=("a", "b", "c"), min_distance=0.3)
    bench.place(qpos=[(0, 0, 0), (0, 0.75, 0), (2.2, 0, 0)])
    assert bench.read(term, "rewards/x").tolist() == [0.0, 1.0, 1.0]
    with pytest.raises(ValueError, match="match one site: give at least two"):
        bench.read(mdp.FeetTooClose(sites="a", min_distance=0.3), "rewards/x")


def test_soft_landing_is_the_impact_force_at_touch_down_only(boxes):
    term = mdp.SoftLanding(sensor="touch", **GATE)
    boxes.command([MOVING, IDLE])
    boxes.place(qpos=boxes_at(0.0, 0.5))
    boxes.step()
    force = boxes.view.contact("touch").force_EN3[0, 0].norm()
    assert 15.0 < force < 60.0
    torch.testing.assert_close(boxes.read(term, "rewards/x"), torch.stack((force, torch.zeros(()))))
    boxes.step()
    torch.testing.assert_close(boxes.read(term, "rewards/x"), torch.zeros(2))


def test_air_time_counts_flights_between_the_thresholds(boxes):
    term = mdp.FeetAirTime(sensor="touch", threshold_min=0.05, threshold_max=0.09, **GATE)
    boxes.command([MOVING, IDLE])
    boxes.place(qpos=boxes_at(1.0, 0.0))
    counts = []
    for _ in range(5):  # flights of 0.02, 0.04, ... 0.10 s
        boxes.step()
        counts.append(boxes.read(term, "rewards/x").tolist())
    assert counts == [[0, 0], [0, 0], [1, 0], [1, 0], [0, 0]]


def test_gait_phase_is_the_share_of_feet_in_the_wanted_phase(boxes):
    term = mdp.GaitPhase(gait="gait", sensor="touch", **GATE)
    boxes.command([MOVING, MOVING])
    boxes.place(qpos=boxes_at(0.0, 0.5))
    boxes.step()
    # Box a stands, box b is in the air. Sines ask: swing where positive.
    for sines, share in (
        ((-0.5, 0.5), 1.0),
        ((0.5, -0.5), 0.0),
        ((-0.5, -0.5), 0.5),
        ((0.5, 0.5), 0.5),
    ):
        boxes.driver.readings.commands["gait"] = torch.tensor([[*sines, 9.0, 9.0]]).expand(2, 4)
        assert boxes.read(term, "rewards/x").tolist() == [share, share]
    boxes.command([MOVING, IDLE])
    assert boxes.read(term, "rewards/x").tolist() == [0.5, 0.0]
    boxes.driver.readings.commands["gait"] = torch.zeros(2, 6)
    with pytest.raises(ValueError, match="'gait' has 3 feet, sensor='touch' has 2"):
        boxes.read(term, "rewards/x")


def test_heights_are_above_the_ground_below_the_foot(free_body):
    free_body.place(qpos=(0, 0, 0.75, 1, 0, 0, 0, 0, 0), qvel=(0.5, 0, 0, 0, 0, 0, 0, 0))
    free_body.command(MOVING)
    free_body.driver.ground = Plateau(3, free_body.view.device)
    term = mdp.FootClearance(sites=(".*_foot",), target_height=0.3, **GATE)
    # Both feet are at 0.35 m, 0.1 m above the plateau.
    value = free_body.read(term, "rewards/x")
    torch.testing.assert_close(value, torch.full((3,), 2 * 0.2 * 0.5), atol=1e-5, rtol=0)
