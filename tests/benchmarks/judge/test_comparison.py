"""What differs from C fails by the limits of the issue: 1e-4 and 1e-3 of the scale, and 30 times what rounding does."""

import mujoco
import numpy as np
import pytest

from benchmarks.judge import c_engine
from benchmarks.judge.comparison import DIRECT, SOLVED, differences, limit_of, scales_of
from benchmarks.judge.worlds import ROUNDING, Arrays, jacobian_rounding, state_of

XML = """
<mujoco>
  <option integrator="{integrator}"/>
  <worldbody>
    <body><joint name="j" axis="0 1 0" damping="0.1"/><geom size="0.1" pos="0.2 0 0"/></body>
  </worldbody>
  <sensor><jointpos joint="j" name="where"/><jointvel joint="j" name="speed"/></sensor>
</mujoco>
"""


def model(integrator: str = "Euler") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML.format(integrator=integrator))


def start(mj_model: mujoco.MjModel) -> Arrays:
    mj_data = mujoco.MjData(mj_model)
    mj_data.qvel[:] = 0.3
    return state_of(mj_data)


def found_with(change: float, quantity: str) -> list[str]:
    """Return which quantities differ where one is changed by so much of its scale."""
    mj_model = model()
    state = start(mj_model)
    expected, _ = c_engine.run(mj_model, state, 4)
    scales = scales_of([expected])
    actual = dict(expected)
    actual[quantity] = expected[quantity] + change * scales[quantity]
    found = differences(
        *(mj_model, state, 4, actual, expected), scales=scales, seed=0, world=0, when="step(4)"
    )
    return [finding.quantity for finding in found]


@pytest.mark.parametrize(
    ("quantity", "limit"), [("qpos", DIRECT), ("qvel", SOLVED), ("cacc", SOLVED)]
)
def test_what_is_beyond_the_limit_fails(quantity: str, limit: float):
    assert found_with(1.5 * limit, quantity) == [quantity]
    assert found_with(0.5 * limit, quantity) == []


def test_nan_fails():
    assert found_with(np.nan, "qpos") == ["qpos"]


PRESSED = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.05"><joint axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body>
    <body pos="3 0 3"><joint axis="0 1 0" limited="true" range="1 2"/><geom size="0.1" pos="0.2 0 0"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("jacobian", ("dense", "sparse"))
def test_rounding_of_the_jacobian_counts_on_joints_of_what_touches(jacobian: str):
    mj_model = mujoco.MjModel.from_xml_string(
        PRESSED.replace("<worldbody>", f'<option jacobian="{jacobian}"/><worldbody>')
    )
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    # One body touches the ground, and the other is at its limit.
    assert mj_data.ncon == 1 and mj_data.nl == 1
    noise = jacobian_rounding(mj_model, state_of(mj_data))
    of_contact = mj_data.efc_type == mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL
    pressing = np.abs(mj_data.efc_force[of_contact]).sum()
    assert noise == pytest.approx([ROUNDING * mj_model.stat.meansize * pressing, 0.0], rel=1e-3)
    assert pressing > 1.0


def test_limits_do_not_grow_with_substeps():
    for quantity in ("qpos", "qvel", "xpos", "sensor jointpos where", "sensor jointvel speed"):
        assert limit_of(model(), quantity, 10) == limit_of(model(), quantity, 2)


def test_forces_of_the_start_are_direct_where_no_solver_came_before():
    assert limit_of(model(), "qfrc_passive", 1) == DIRECT
    assert limit_of(model(), "qfrc_passive", 2) == SOLVED
    assert limit_of(model("RK4"), "qfrc_passive", 1) == SOLVED


def test_all_quantities_of_runge_kutta_are_compared():
    mj_model = model("RK4")
    of_runge_kutta, _ = c_engine.run(mj_model, start(mj_model), 1)
    of_euler, _ = c_engine.run(model(), start(mj_model), 1)
    assert of_runge_kutta.keys() == of_euler.keys()
    assert {"qacc", "qfrc_constraint", "cfrc_int"} <= of_runge_kutta.keys()
