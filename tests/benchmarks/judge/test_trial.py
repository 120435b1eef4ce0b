"""A trial sees what views, resets and hooks show, and fails where one of them is wrong."""

import mujoco
import pytest
import torch

from benchmarks.judge import worlds
from benchmarks.judge.c_engine import touched_accepted
from benchmarks.judge.trial import judge
from benchmarks.judge.worlds import state_of
from ksim_rl.physics.warp_world import WarpWorld

XML = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.1"><joint name="j" type="slide" axis="0 0 1" damping="0.5"/><geom size="0.1"/></body>
  </worldbody>
  <sensor><jointpos joint="j" name="height"/></sensor>
</mujoco>
"""
# A beam that lies on the ground, and turns about its middle.
BALANCED = """
<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1"/>
    <body pos="0 0 0.045">
      <joint type="hinge" axis="0 1 0"/><geom name="beam" type="capsule" size="0.05 0.1" euler="0 90 0"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_a_model_that_is_right_is_judged_in_all_parts():
    verdict = judge(XML, kernels="theirs", fields=("body_mass",))
    assert verdict.findings == ()
    assert verdict.states == 20
    assert verdict.touching
    assert verdict.reset
    # Of the three worlds with another mass, two have one that XML says for certain.
    assert verdict.compiled >= 2


def test_a_reset_that_leaves_something_is_found(monkeypatch: pytest.MonkeyPatch):
    true_reset = WarpWorld.reset

    def leaving(world: WarpWorld, mask_E: torch.Tensor) -> None:
        true_reset(world, mask_E)
        if not bool(mask_E.all()):
            world.view("qacc_warmstart")[0] += 100.0

    monkeypatch.setattr(WarpWorld, "reset", leaving)
    quantities = {finding.quantity for finding in judge(XML, kernels="theirs").findings}
    assert "reset qacc" in quantities


def test_a_refusal_is_no_finding():
    verdict = judge(XML.replace("<worldbody>", '<option solver="PGS"/><worldbody>'))
    assert "mjSOL_PGS" in verdict.refused
    assert verdict.states == 0


def test_kinetic_energy_is_compared_of_the_same_state():
    option = '<option><flag energy="enable"/></option>'
    xml = XML.replace("<worldbody>", option + "<worldbody>").replace(
        "<sensor>", '<sensor><e_kinetic name="kinetic"/>'
    )
    assert judge(xml, kernels="theirs").findings == ()


def test_contacts_that_may_differ_are_looked_for_in_each_substep():
    ball = '<geom type="ellipsoid" size="0.1 0.1 0.1"/>'
    xml = f"<mujoco><worldbody>{ball}<body pos='0 0 0.199'><freejoint/>{ball}</body></worldbody></mujoco>"
    mj_model = mujoco.MjModel.from_xml_string(xml)
    mj_data = mujoco.MjData(mj_model)
    # So fast that they touch in the first substep alone.
    mj_data.qvel[2] = 10.0
    state = state_of(mj_data)
    assert touched_accepted(mj_model, state, 3)
    assert not touched_accepted(mj_model, state, 1)
    mj_data.qpos[2] = 1.0
    assert not touched_accepted(mj_model, state_of(mj_data), 3)


def test_what_turns_about_its_centre_of_mass_has_a_weight_in_both_engines(
    monkeypatch: pytest.MonkeyPatch,
):
    assert judge(BALANCED, kernels="theirs").findings == ()
    monkeypatch.setattr(worlds, "least_weights", lambda mj_model: 0.0)
    assert judge(BALANCED, kernels="theirs").findings
