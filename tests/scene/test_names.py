"""Names and patterns to indices."""

import mujoco
import pytest
import torch

from ksim_rl.scene.names import NameResolver

XML = """
<mujoco>
  <worldbody>
    <body name="trunk"><freejoint/><geom name="shell" size=".1"/>
      <body name="left"><joint name="left_hip"/><joint name="left_knee"/><geom size=".1"/></body>
      <body name="right"><joint name="right_hip"/><joint name="right_knee"/><geom size=".1"/></body>
    </body>
  </worldbody>
  <actuator><motor name="b" joint="right_hip"/><motor name="a" joint="left_hip"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def resolver():
    return NameResolver(mujoco.MjModel.from_xml_string(XML), torch.device("cpu"))


def test_patterns_match_in_model_order_and_names_in_their_own(resolver):
    assert resolver.ids("joint", ".*_hip") == (0, 2)
    assert resolver.ids("joint", ("right_hip", "left_hip")) == (2, 0)


def test_contiguous_ids_are_a_slice(resolver):
    assert resolver.index("joint", ".*") == slice(0, 4)
    assert torch.equal(resolver.index("joint", ".*_hip"), torch.tensor([0, 2]))


def test_a_pattern_matches_the_whole_name(resolver):
    with pytest.raises(ValueError, match="no joint matches 'left'"):
        resolver.ids("joint", "left")


def test_no_match_lists_near_names(resolver):
    with pytest.raises(ValueError, match="'left_knee'"):
        resolver.ids("joint", "left_kne")


def test_a_double_match_is_refused(resolver):
    with pytest.raises(ValueError, match="two of the patterns"):
        resolver.ids("joint", ("left_.*", ".*_hip"))


def test_one_is_one(resolver):
    assert resolver.one("body", "left") == resolver.one("body", "lef.") == 2
    with pytest.raises(ValueError, match=r"matches \['left', 'right'\]: name one of them"):
        resolver.one("body", "left|right")


def test_a_broken_pattern_is_refused(resolver):
    with pytest.raises(ValueError, match="no regular expression"):
        resolver.ids("joint", "(")
