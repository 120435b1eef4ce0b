"""When events fire, what they may touch, and what follows from what they write."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from ksim_rl.envs import EnvView, ManagerBasedRlEnv, MjcfRobot, SceneCfg
from ksim_rl.envs.term import EventTerm
from tests.envs.probe_env import DT, PUCK_XML, Kick, Launch, puck_cfg, push

KEYFRAME = '<keyframe><key name="start" qpos="0.75" qvel="9"/></keyframe></mujoco>'


@dataclass(frozen=True, kw_only=True)
class Heavier(EventTerm):
    """Add 1 kg to the puck."""

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        return ("body_mass",)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        mass_E = view.field("body_mass")[:, 1]
        mass_E.add_(mask_E)


@dataclass(frozen=True, kw_only=True)
class WritesThenReads(EventTerm):
    """Reads where a body is after it has moved it."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        view.joints().write_pos(mask_E, torch.ones(view.num_envs, 1))
        assert view.bodies("puck").pos_EN3.isfinite().all()


def env_of(events, *, source=PUCK_XML, **fields):
    """Build the puck env with `events` as they stand, None included."""
    cfg = puck_cfg(
        limit=None, scene=SceneCfg(robots={"puck": MjcfRobot(source=source)}, num_envs=3), **fields
    )
    return ManagerBasedRlEnv(replace(cfg, events=events))


def start_of(env):
    """Return position and velocity after a reset, having been elsewhere before."""
    env.reset()
    env.world.qpos_EL.fill_(5.0), env.world.qvel_EL.fill_(5.0)
    root_E = env.reset()
    return root_E["obs", "position"].unique().tolist(), root_E["obs", "velocity"].unique().tolist()


def test_no_events_configured_means_the_first_keyframe():
    assert start_of(env_of(None, source=PUCK_XML.replace("</mujoco>", KEYFRAME))) == ([0.75], [9.0])


def test_no_events_configured_and_no_keyframe_means_the_default_pose():
    source = PUCK_XML.replace('axis="1 0 0"', 'axis="1 0 0" ref="0.5"')
    assert start_of(env_of(None, source=source)) == ([0.5], [0.0])


def test_without_events_a_reset_is_to_the_first_keyframe_too():
    assert start_of(env_of({}, source=PUCK_XML.replace("</mujoco>", KEYFRAME))) == ([0.75], [9.0])


def test_events_run_in_their_order():
    first, then = Launch(speed=1.0), Kick()
    assert start_of(env_of({"launch": first, "kick": then}))[1] == [2.0, 3.0, 4.0]
    assert start_of(env_of({"kick": then, "launch": first}))[1] == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("steps", [1, 2, 7, 13, 50])
def test_an_interval_of_n_steps_ends_at_the_nth(steps):
    kick = Kick(mode="interval", interval_range_s=(steps * DT, steps * DT))
    env = env_of({"launch": Launch(speed=0.0), "kick": kick})
    root_E, fired = env.reset(), []
    for n in range(1, 2 * steps + 2):
        root_E = push(env, root_E)["next"].clone()
        fired.append(round(float(root_E["obs", "velocity"][0, 0])) == n // steps)
    assert all(fired)


def test_intervals_are_drawn_per_env_and_start_anew_with_the_episode():
    kick = Kick(mode="interval", interval_range_s=(2 * DT, 6 * DT))
    env = env_of({"launch": Launch(speed=0.0), "kick": kick})
    root_E = env.reset()
    for n in range(1, 60):
        root_E = push(env, root_E)["next"].clone()
        kicks_E = root_E["obs", "velocity"][:, 0].round()
        assert (kicks_E >= n // 6 - 1).all() and (kicks_E <= n / 2).all()
    assert len(kicks_E.unique()) > 1
    root_E = env.reset(env_ids=[0])
    root_E = push(env, root_E)["next"]
    assert root_E["obs", "velocity"][0].eq(0.0).all(), (
        "the clock of a row that resets is at least two steps"
    )


def test_a_startup_event_fires_once_per_seed_and_for_all_rows():
    env = env_of({"heavier": Heavier(mode="startup")})
    root_E = env.reset()
    env.reset()
    push(env, root_E, force=1.0)
    assert env.world.field("body_mass")[:, 1].tolist() == [2.0] * 3
    torch.testing.assert_close(env.world.qvel_EL, torch.full((3, 1), DT / 2.0))


@pytest.mark.parametrize("mode", ["startup", "reset", "step", "interval"])
def test_what_derives_from_a_model_field_follows_at_once(mode):
    # The mass of the whole tree is what MuJoCo derives from the bodies' masses.
    every_step = (DT, DT) if mode == "interval" else None
    env = env_of({"heavier": Heavier(mode=mode, interval_range_s=every_step)})
    root_E = env.reset()
    for _ in range(2):
        root_E = push(env, root_E)["next"].clone()
        mass_E = env.world.field("body_mass")[:, 1]
        torch.testing.assert_close(env.world.field("body_subtreemass")[:, 0], mass_E)
    assert mass_E.tolist() == [3.0 if mode in ("step", "interval") else 2.0] * 3


def test_a_reset_event_changes_the_model_of_its_rows_only():
    env = env_of({"heavier": Heavier(mode="reset")})
    env.reset()
    env.reset(env_ids=[1])
    assert env.world.field("body_mass")[:, 1].tolist() == [2.0, 3.0, 2.0]


def test_an_event_that_reads_what_it_has_made_stale_is_refused_at_construction():
    with pytest.raises(RuntimeError, match="events/bad reads a derived quantity"):
        env_of({"bad": WritesThenReads()})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"mode": "intervall"}, "mode='intervall': did you mean 'interval'"),
        ({"mode": "interval"}, "interval_range_s=None with mode='interval'"),
        (
            {"mode": "reset", "interval_range_s": (1.0, 2.0)},
            "interval_range_s=.* with mode='reset'",
        ),
        (
            {"mode": "interval", "interval_range_s": (2.0, 1.0)},
            "interval_range_s=.*low exceeds high",
        ),
    ],
)
def test_modes_and_intervals_go_together(fields, message):
    with pytest.raises(ValueError, match=message):
        Kick(**fields)
