"""Worlds with too little room say so, and the judge would see it if they did not."""

import dataclasses

import mujoco
import pytest

from benchmarks.judge.small_room import untold_overflow
from benchmarks.judge.trial import SETTINGS
from benchmarks.judge.worlds import state_of
from ksim_rl.physics import load_model
from ksim_rl.physics.overflow import OverflowReport
from ksim_rl.physics.warp_world import WarpWorld

RESTING = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.09"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""
FALLING = RESTING.replace("0 0 0.09", "0 0 3")
SIM = SETTINGS["theirs"]


def looked_at(xml: str) -> object:
    mj_model = load_model(xml, SIM)
    state = state_of(mujoco.MjData(mj_model))
    beside = WarpWorld(mj_model, num_envs=2, device="cpu", sim=SIM)
    return untold_overflow(beside, [state] * 2)


def test_a_box_that_rests_needs_more_rows_and_says_so():
    assert looked_at(RESTING) == ()


def test_where_nothing_touches_there_is_room():
    assert looked_at(FALLING) is None


def test_what_is_not_said_is_found(monkeypatch: pytest.MonkeyPatch):
    true_report = WarpWorld.overflow_report

    def silent(world: WarpWorld) -> OverflowReport:
        return dataclasses.replace(true_report(world), worlds={})

    monkeypatch.setattr(WarpWorld, "overflow_report", silent)
    found = looked_at(RESTING)
    assert isinstance(found, tuple)
    assert found[0].kind == "overflow"
    assert found[0].error > found[0].limit
