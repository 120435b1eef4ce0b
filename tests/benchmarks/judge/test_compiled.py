"""A world's model is compared with one that C compiled from XML that has the fields of the world."""

import copy

import mujoco
import numpy as np
import pytest

from benchmarks.judge.compiled import compiled_with
from benchmarks.judge.worlds import sayable
from ksim_rl.physics import SimCfg
from ksim_rl.physics.fields import write_fields

XML = """
<mujoco>
  <worldbody>
    <body name="a" pos="0 0 1"><joint name="h" damping="0.1"/><geom size="0.1" pos="0.1 0 0"/>
      <body name="b" pos="0.2 0 0"><joint name="k" type="ball" damping="0.2"/><geom size="0.1"/></body>
    </body>
  </worldbody>
</mujoco>
"""


def with_field(name: str, values: np.ndarray) -> mujoco.MjModel:
    mj_model = mujoco.MjModel.from_xml_string(XML)
    write_fields(mj_model, {name: values})
    return mj_model


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("body_mass", 1.5),
        ("dof_damping", 2.0),
        ("geom_pos", 1.2),
        ("body_gravcomp", 0.0),
        ("body_inertia", 1.1),
    ],
)
def test_the_compiler_reaches_the_same_model(name: str, change: float):
    plain = mujoco.MjModel.from_xml_string(XML)
    values = change * np.array(getattr(plain, name))
    if name == "body_gravcomp":
        values[1:] = 0.7
    found = compiled_with(XML, SimCfg(), with_field(name, values))
    assert found is not None
    np.testing.assert_allclose(getattr(found, name), values, rtol=1e-12)
    assert found is not plain


def test_what_no_xml_says_is_not_compiled():
    # Each axis of a ball has its own damping.
    values = np.array([0.1, 0.2, 0.3, 0.4])
    assert compiled_with(XML, SimCfg(), with_field("dof_damping", values)) is None


def test_constants_that_do_not_follow_are_not_taken_for_the_same():
    mj_model = with_field("body_mass", np.array([0.0, 3.0, 2.0]))
    stale = copy.copy(mj_model)
    stale.dof_invweight0[0] *= 2.0
    assert compiled_with(XML, SimCfg(), mj_model) is not None
    assert compiled_with(XML, SimCfg(), stale) is None


def test_what_is_drawn_can_be_said():
    mj_model = mujoco.MjModel.from_xml_string(XML)
    drawn = np.array([1.0, 2.0, 3.0, 4.0])
    assert sayable(mj_model, "dof_damping", drawn).tolist() == [1.0, 2.0, 2.0, 2.0]
