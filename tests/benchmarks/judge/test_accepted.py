"""What may differ from the C engine is judged by limits, and balls in fields of heights at any depth."""

import mujoco
import numpy as np
import pytest

from benchmarks.judge.accepted import (
    DEEP,
    DEPTH_CEILINGS,
    ELEMENT,
    depth_limit,
    depths_in_c,
    kinds_of,
)
from benchmarks.judge.worlds import drawn_state, put
from tests.benchmarks.judge.rare_models import MODELS

XML = """
<mujoco>
  <asset><hfield name="field" nrow="2" ncol="2" size="1 1 0.1 0.1" elevation="0 1 1 0"/></asset>
  <worldbody>
    <geom name="field" type="hfield" hfield="field"/>
    <geom name="ball" size="0.1"/>
    <geom name="box" type="box" size="0.1 0.1 0.1" margin="0.01"/>
    <geom name="egg" type="ellipsoid" size="0.1 0.2 0.1" margin="0.01"/>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("first", "second", "shallow", "deep"),
    (
        ("field", "ball", DEPTH_CEILINGS["hfield"], DEPTH_CEILINGS["hfield"]),
        ("field", "box", DEPTH_CEILINGS["hfield"] + 0.01, None),
        ("box", "egg", DEPTH_CEILINGS["ellipsoid"], None),
    ),
)
def test_depths_are_compared_where_they_are_one(
    first: str, second: str, shallow: float, deep: float | None
) -> None:
    mj_model = mujoco.MjModel.from_xml_string(XML)
    pair = (mj_model.geom(first).id, mj_model.geom(second).id)
    assert depth_limit(mj_model, pair, -0.001, -0.002) == pytest.approx(shallow)
    found = depth_limit(mj_model, pair, -0.001, -2 * DEEP)
    assert found == (None if deep is None else pytest.approx(deep))


def test_elements_that_touch_each_other_are_looked_for_and_what_touches_a_geom_is_not() -> None:
    mj_model = mujoco.MjModel.from_xml_string(MODELS["cloths that touch themselves"])
    rng = np.random.default_rng(0)
    crumpled = [drawn_state(mj_model, rng, forces=False) for _ in range(2)][1]
    mj_data = put(crumpled, mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    found = depths_in_c(mj_data)
    of_ground = (np.array(mj_data.contact.geom) >= 0).any(-1)
    assert of_ground.any() and len(found) == (~of_ground).sum() > 0
    for pair, depth in found.items():
        assert min(pair) >= mj_model.ngeom and kinds_of(mj_model, pair) == (ELEMENT, ELEMENT)
        assert depth_limit(mj_model, pair, depth, depth) in (None, DEPTH_CEILINGS["element"])
