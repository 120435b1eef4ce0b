"""An env whose resets need more room than its model's poses show gets it before anything else happens."""

from dataclasses import dataclass

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from ksim_rl.envs import EnvView, MjcfRobot, SceneCfg, with_room
from ksim_rl.envs.room import rehearse_room
from ksim_rl.envs.term import EventTerm
from ksim_rl.physics import SimCfg, capacity
from ksim_rl.physics.nan_guard.guard import NanGuardCfg
from tests.envs.probe_env import Kick, RandomLaunch, puck_cfg, puck_env

WALL_AT = 5.0
BALLS = "".join(
    f'<geom type="sphere" size="0.1" mass="1" pos="0 {0.3 * index} 0"/>' for index in range(12)
)
SLED_XML = f"""
<mujoco model="sled">
  <option timestep="0.005" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <geom type="box" pos="{WALL_AT} 1.5 0" size="0.05 3 1"/>
    <body name="sled"><joint name="rail" type="slide" axis="1 0 0"/>{BALLS}</body>
  </worldbody>
  <actuator><motor name="push" joint="rail"/></actuator>
</mujoco>
"""


@dataclass(frozen=True, kw_only=True)
class PutIntoWall(EventTerm):
    """Start with all balls a millimetre deep in the wall, where no pose of the model's own probe is."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        view.joints().write_pos(mask_E, torch.full((view.num_envs, 1), WALL_AT - 0.149))


def sled_env(sim: SimCfg | None = None, num_envs: int = 3):
    scene = SceneCfg(robots={"sled": MjcfRobot(source=SLED_XML)}, num_envs=num_envs)
    return puck_env(scene=scene, events={"put": PutIntoWall()}, limit=None, sim=sim or SimCfg())


def test_room_grows_to_what_a_rehearsal_needed_and_a_line_says_so(monkeypatch):
    monkeypatch.setattr(capacity, "_cache", {})
    short = sled_env()
    assert (short.world.njmax, short.world.nconmax) == (8, 8), "the probe sees no contact"
    assert not rehearse_room(short).ok
    said: list[str] = []
    env = with_room(sled_env, note=said.append)
    assert env.world.njmax >= 12 * 4 and env.world.nconmax >= 12
    assert said == [
        "room for contacts and constraint rows has grown after a rehearsal: "
        f"task.sim.njmax 8 -> {env.world.njmax}, task.sim.nconmax 8 -> {env.world.nconmax}"
    ]
    state = env.reset()
    for _ in range(3):
        state["action"] = torch.ones(3, 1)
        _, state = env.step_and_maybe_reset(state)
    assert env.world.overflow_report().ok
    later = sled_env(num_envs=1)
    assert later.world.njmax == env.world.njmax, "such as the envs of evaluations"
    said.clear()
    with_room(sled_env, note=said.append)
    assert not said


def test_numbers_of_the_config_stay_and_what_is_lost_is_told():
    said: list[str] = []
    env = with_room(lambda: sled_env(SimCfg(njmax=9)), note=said.append)
    assert env.world.njmax == 9
    assert any("warning" in text and "set sim.njmax >= 48" in text for text in said), said
    said.clear()
    env = with_room(lambda: sled_env(SimCfg(njmax=9, nconmax=2)), note=said.append)
    assert (env.world.njmax, env.world.nconmax, said) == (9, 2, []), "the run itself tells it"


def test_a_rehearsal_leaves_no_trace(tmp_path):
    fields = {
        "events": {
            "launch": RandomLaunch(),
            "kick": Kick(mode="interval", interval_range_s=(0.04, 0.1)),
        }
    }
    sim = SimCfg(nan_guard=NanGuardCfg(folder=str(tmp_path)))
    new, rehearsed = (puck_env(episode_length_s=0.5, sim=sim, **fields) for _ in range(2))
    drawn = torch.get_rng_state()
    rehearse_room(rehearsed)
    assert torch.equal(torch.get_rng_state(), drawn)
    ends = []
    for env in (new, rehearsed):
        state = env.reset()
        for _ in range(8):
            state["action"] = torch.ones(env.num_envs, 1)
            stepped, state = env.step_and_maybe_reset(state)
            ends.append(stepped.clone())
    for one, other in zip(ends[:8], ends[8:], strict=True):
        assert isinstance(one, TensorDict) and (one == other).all()
    assert new.state_dict().keys() == rehearsed.state_dict().keys()
    for name, value in new.state_dict().items():
        assert torch.equal(value, rehearsed.state_dict()[name]), name


def test_worlds_that_fail_in_a_rehearsal_are_not_reported(tmp_path):
    sim = SimCfg(nan_guard=NanGuardCfg(folder=str(tmp_path)))
    env = puck_env(limit=None, sim=sim, events={"break": Break()})
    rehearse_room(env)
    assert int(env.world.nan_count()) == 0 and env.world.nan_report().ok
    assert not list(tmp_path.iterdir()) and not env.non_finite_terms()


@dataclass(frozen=True, kw_only=True)
class Break(EventTerm):
    """Start with a velocity that is not finite."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        view.joints().write_vel(mask_E, torch.full((view.num_envs, 1), torch.nan))


def test_an_env_without_contacts_is_not_rehearsed(monkeypatch):
    monkeypatch.setattr("ksim_rl.envs.room.rehearse_room", lambda env: pytest.fail("rehearsed"))
    env = with_room(puck_env, note=pytest.fail)
    assert env.world.room_is_certain
    assert not sled_env().world.room_is_certain
    assert puck_cfg().sim.njmax is None
