"""The env's attributes and methods, one test for each that `test_manager_based_rl_env` and others leave out.

Config fields are tested in `tests/integration/test_config_reaches_env`.
"""

import inspect
from dataclasses import dataclass

import mujoco
import mujoco_warp
import pytest
import torch
import warp
from torchrl.envs import EnvBase

from ksim_rl import mdp
from ksim_rl.envs import (
    EnvView,
    ManagerBasedRlEnv,
    ObservationGroupCfg,
    ObservationTermCfg,
    registry,
)
from ksim_rl.envs.term import (
    ActionTerm,
    CommandTerm,
    CurriculumTerm,
    EventTerm,
    MetricTerm,
    ObservationTerm,
    RewardTerm,
    TerminationTerm,
)
from ksim_rl.transforms.noise.cfg import UniformNoise
from tests.envs.probe_env import DT, Launch, RandomLaunch, puck_cfg, puck_env, push
from tests.mdp.recorder import Recorder


@pytest.fixture(scope="module")
def env():
    return puck_env(episode_length_s=0.19)


# -- attributes --------------------------------------------------------------------------------------------------


def test_it_is_a_torchrl_env_of_many(env):
    assert isinstance(env, EnvBase) and env.is_vector_env is True
    assert env.unwrapped is env and env.device == torch.device("cpu")
    assert (
        env.cfg.decimation == 4
        and env.num_envs == env.cfg.scene.num_envs == env.batch_size.numel() == 3
    )
    assert env.batch_size == torch.Size([3])


def test_metadata_names_the_versions_and_the_render_modes(env):
    assert env.metadata == {
        "mujoco_version": mujoco.__version__,
        "warp_version": warp.__version__,
        "mujoco_warp_version": mujoco_warp.__version__,
        "render_modes": [None, "rgb_array"],
    }


@pytest.mark.parametrize(
    ("seconds", "steps"), [(0.0, 0), (0.19, 10), (0.2, 10), (0.201, 11), (20.0, 1000)]
)
def test_an_episode_lasts_the_steps_that_its_seconds_need(seconds, steps):
    cfg = puck_cfg(episode_length_s=seconds)
    env = ManagerBasedRlEnv(cfg)
    assert (env.max_episode_length_s, env.max_episode_length) == (seconds, steps)
    assert env.step_dt == pytest.approx(env.physics_dt * cfg.decimation) == pytest.approx(DT)


# -- load_managers -----------------------------------------------------------------------------------------------

calls: list[str] = []


def _noted(kind, result):
    def call(self, view: EnvView, *arguments: object) -> object:
        calls.append(kind)
        return result(view)

    return call


def _zeros(view):
    return torch.zeros(view.num_envs)


def _column(view):
    return torch.zeros(view.num_envs, 1)


@dataclass(frozen=True, kw_only=True)
class NotedCommand(CommandTerm):
    resample = _noted("command", lambda view: None)
    __call__ = _noted("command", _column)


@dataclass(frozen=True, kw_only=True)
class NotedAction(ActionTerm):
    size = _noted("action", lambda view: 1)
    __call__ = _noted("action", lambda view: None)


NOTED = {
    EventTerm: ("event", lambda view: None),
    ObservationTerm: ("observation", _column),
    RewardTerm: ("reward", _zeros),
    TerminationTerm: ("termination", lambda view: torch.zeros(view.num_envs, dtype=torch.bool)),
    MetricTerm: ("metric", _zeros),
    CurriculumTerm: ("curriculum", lambda view: torch.zeros(())),
}


def noted(base, **fields):
    """Return a term of a kind that notes when it is called."""
    kind, result = NOTED[base]
    return dataclass(frozen=True, kw_only=True)(
        type(kind, (base,), {"__call__": _noted(kind, result)})
    )(**fields)


def noted_env():
    observed = {"x": ObservationTermCfg(term=noted(ObservationTerm))}
    return puck_env(
        events={"x": noted(EventTerm)},
        commands={"x": NotedCommand(resampling_time_range_s=None)},
        actions={"x": NotedAction()},
        observations={"actor": ObservationGroupCfg(terms=observed)},
        rewards={"x": noted(RewardTerm), "off": noted(RewardTerm, weight=0.0)},
        terminations={"x": noted(TerminationTerm)},
        metrics={"x": noted(MetricTerm)},
        curriculum={"x": noted(CurriculumTerm)},
    )


def in_order():
    """Return the kinds in the order of their first call, and start over."""
    kinds = list(dict.fromkeys(calls))
    calls.clear()
    return kinds


def test_managers_are_loaded_events_and_commands_first_then_actions_and_observations():
    calls.clear()
    env = noted_env()
    kinds = in_order()
    assert kinds[:4] == ["event", "command", "action", "observation"]
    assert set(kinds[4:]) == {"reward", "termination", "metric", "curriculum"}
    assert {name for name in vars(env) if name.endswith("_manager")} == {
        f"{kind}_manager"
        for kind in (
            "action", "command", "curriculum", "event", "metric", "observation", "reward", "termination"
        )
    }  # fmt: skip


def test_a_step_and_a_reset_run_the_managers_in_their_order():
    env = noted_env()
    calls.clear()
    root_E = env.reset()
    assert in_order() == ["curriculum", "event", "command", "observation"]
    env.step(root_E.set("action", torch.zeros(3, 1)))
    assert in_order() == ["action", "termination", "reward", "metric", "command", "observation"]


def test_reset_events_read_nothing_of_the_episode_that_ended():
    seen = []

    @dataclass(frozen=True, kw_only=True)
    class Look(EventTerm):
        """Notes where the puck is, off the default pose."""

        def __call__(self, view, mask_E):
            seen.append(view.joint_pos_rel_EL[:, 0].tolist())

    env = puck_env(limit=None, events={"look": Look()})
    env.reset()
    env.world.qpos_EL.fill_(2.0)
    env.world.refresh()
    env.driver.refreshed()
    assert env.view.joint_pos_rel_EL[:, 0].tolist() == [2.0] * 3
    env.reset(env_ids=[1])
    assert seen[-1] == [2.0, 0.0, 2.0]


def test_a_reward_of_weight_zero_is_not_computed():
    env = noted_env()
    root_E = env.reset()
    calls.clear()
    env.step(root_E.set("action", torch.zeros(3, 1)))
    assert calls.count("reward") == 1


def test_managers_name_their_terms(env):
    assert env.reward_manager.names == ("position",)
    assert env.termination_manager.names == ("beyond", "time_out", "non_finite")
    assert list(env.event_manager.terms) == ["launch"] and env.action_manager.sizes == {"push": 1}


# -- debug drawing -----------------------------------------------------------------------------------------------


def test_terms_draw_the_env_that_the_viewer_shows():
    reach = mdp.CartesianCommand(
        resampling_time_range_s=None, position={"x": (0.5, 0.5)}, frame="root"
    )
    env = puck_env(limit=None, commands={"reach": reach})
    push(env, env.reset())
    assert "commands/reach" in env.setup_manager_visualizers()
    recorder = Recorder()
    env.update_visualizers(recorder)
    spheres = [what for kind, *what in recorder.drawn if kind == "sphere"]
    assert list(spheres[0][0]) == pytest.approx([0.52, 0.0, 0.0])


# -- reset, step, seed, close ------------------------------------------------------------------------------------


def test_reset_has_torchrls_parameters_and_ours():
    parameters = inspect.signature(ManagerBasedRlEnv.reset).parameters
    names = [name for name in parameters if name != "self"]
    assert names[:1] == ["tensordict"] and {"seed", "env_ids", "options", "kwargs"} <= set(names)
    assert all(
        parameters[name].kind is inspect.Parameter.KEYWORD_ONLY
        for name in ("seed", "env_ids", "options")
    )


def test_reset_with_a_seed_is_a_seeded_reset():
    env, twin = (puck_env(events={"launch": RandomLaunch()}) for _ in range(2))
    first = env.reset(seed=5)["obs", "velocity"].clone()
    twin.seed(5)
    assert torch.equal(twin.reset()["obs", "velocity"], first) and env.cfg.seed == 5
    assert not torch.equal(env.reset(seed=6)["obs", "velocity"], first)


def test_a_seed_of_minus_one_is_drawn_and_another_each_time():
    env = puck_env(seed=3)
    assert env.cfg.seed == 3
    drawn = [env.seed(-1), env.seed()]
    assert drawn[0] != drawn[1] and min(drawn) >= 0 and env.cfg.seed == drawn[1]


def test_both_ways_to_seed_reach_the_transforms():
    terms = {
        "velocity": ObservationTermCfg(term=mdp.JointVel(), noise=UniformNoise(low=-1.0, high=1.0)),
    }
    env = registry.build(puck_cfg(observations={"actor": ObservationGroupCfg(terms=terms)}))

    def noise():
        root_E = env.reset()
        return (root_E["actor"] - root_E["obs", "velocity"]).clone()

    env.seed(5)
    first = noise()
    env.seed(6)
    assert not torch.equal(noise(), first)
    env.seed(5)
    assert torch.equal(noise(), first)
    following = env.set_seed(5)
    assert torch.equal(noise(), first) and following != 5, "TorchRL's returns the next seed"


def test_step_takes_and_gives_a_tensordict(env):
    root_E = env.reset()
    out_E = env.step(root_E.set("action", torch.zeros(3, 1)))
    assert out_E is root_E and set(out_E["next"].keys()) >= {
        "obs",
        "reward",
        "done",
        "terminated",
        "truncated",
    }
    for key in ("reward", "done", "terminated", "truncated"):
        assert out_E["next", key].shape == (3, 1)


def test_close_frees_the_world_and_says_when_it_is_done_twice():
    env = puck_env()
    world = env.world
    env.close()
    assert env.is_closed and not hasattr(world, "warp_data_E")
    with pytest.raises(RuntimeError, match="closed already"):
        env.close()
    env.close(raise_if_closed=False)
    with pytest.raises(TypeError):
        env.close(False)  # pyright: ignore[reportCallIssue]


# -- fields whose absence has a meaning --------------------------------------------------------------------------


def test_without_terminations_and_events_an_env_goes_on_where_it_is():
    env = puck_env(events={}, limit=None, rewards={}, terminations={})
    root_E = env.reset()
    for _ in range(5):
        env_state_E, root_E = env.step_and_maybe_reset(root_E.set("action", torch.ones(3, 1)))
        assert not env_state_E["next", "done"].any() and env_state_E["next", "reward"].eq(0.0).all()
    assert (root_E["obs", "position"] > 0.0).all()


def test_rewards_are_scaled_by_the_step_and_time_outs_marked_by_the_horizon():
    def last(**fields):
        env = puck_env(limit=None, episode_length_s=DT, events={"launch": Launch()}, **fields)
        next_E = push(env, env.reset())["next"]
        return next_E["reward"], next_E["terminated"].all(), next_E["truncated"].all()

    scaled, terminated, truncated = last()
    assert truncated and not terminated
    plain, terminated, truncated = last(scale_rewards_by_dt=False, is_finite_horizon=True)
    assert terminated and not truncated
    torch.testing.assert_close(scaled, plain * DT)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"decimation": 0}, "decimation=0"),
        ({"seed": -2}, "seed=-2"),
        ({"episode_length_s": -1.0}, r"episode_length_s=-1\.0"),
    ],
)
def test_a_value_out_of_range_is_refused_before_any_model_is_compiled(fields, message, monkeypatch):
    monkeypatch.setattr("ksim_rl.scene.scene.load_model", None)
    with pytest.raises(ValueError, match=message):
        puck_env(**fields)
