"""Compares every figure of the reference task with the config; each that is read is ticked off, none may be left."""

import ast
import dataclasses
import re

import pytest
import torch

from ksim_rl import envs
from ksim_rl.envs.names import NameResolver
from ksim_rl.envs.scene import build_spec
from ksim_rl.envs.transforms.noise_cfg import UniformNoise
from tests.envs.robots.reference import loaded_spec, reference_figures

CFG = envs.task("go1_velocity_flat").cfg()
ROBOT = CFG.scene.robots["go1"]
TRAINING = envs.task("go1_velocity_flat").training
SENSORS = {"feet_ground_contact": "feet_ground_contact", "robot/root_angmom": "root_angmom"}


@pytest.fixture
def figures():
    return reference_figures("unitree_go1")


def joints_by_pattern(table):
    """Spread a table of patterns over the robot's joints, as the reference's search for matches does."""
    return {
        name: value
        for name in ROBOT.joint_names
        for pattern, value in table.items()
        if re.fullmatch(pattern, name)
    }


def test_physics(figures):
    physics = dict(figures["physics"])
    assert physics.pop("decimation") == CFG.decimation
    for name, value in physics.items():
        assert getattr(CFG.sim, name) == value, name


def test_rewards(figures):
    assert list(CFG.rewards) == list(figures["rewards"])
    for name, reference in figures["rewards"].items():
        term, params = CFG.rewards[name], dict(reference["params"])
        assert term.weight == reference["weight"], name
        # Heights above flat ground are those of the foot sites, which a ray sensor reads in the reference.
        if params.pop("height_sensor_name", None):
            assert term.sites == ROBOT.foot_sites
        for field, ours in (("sensor_name", "sensor"), ("command_name", "command")):
            if field in params:
                value = params.pop(field)
                assert getattr(term, ours) == SENSORS.get(value, value), name
        for field, value in params.items():
            ours = getattr(term, field)
            if isinstance(value, dict):
                assert joints_by_pattern(ours) == joints_by_pattern(value), (name, field)
                assert len(joints_by_pattern(ours)) == len(ROBOT.joint_names)
            else:
                assert ours == pytest.approx(value, rel=1e-12), (name, field)


def test_terminations(figures):
    assert list(CFG.terminations) == list(figures["terminations"])
    for name, reference in figures["terminations"].items():
        assert CFG.terminations[name].time_out == reference["time_out"]
        for field, value in reference["params"].items():
            assert getattr(CFG.terminations[name], field) == pytest.approx(float(value), rel=1e-12)


def test_events(figures):
    assert list(CFG.events) == list(figures["events"])
    for name, reference in figures["events"].items():
        term, params = CFG.events[name], dict(reference["params"])
        assert term.mode == reference["mode"], name
        assert term.interval_range_s == as_pair(reference["interval_range_s"]), name
        of = params.pop("of", None)
        if of == "all joints":
            assert term.joints == ".*"
        elif of is not None:
            assert tuple(term.elements) == ast.literal_eval(of)
        if "axes" in params:
            assert {params.pop("axes")[0]: as_pair(params.pop("ranges"))} == term.ranges, name
        elif "ranges" in params:
            assert {int(axis): as_pair(pair) for axis, pair in params.pop("ranges").items()} == term.ranges
        if "shared_random" in params:
            assert params.pop("shared_random") == term.shared
            assert params.pop("distribution", "uniform") == term.distribution
        for field, value in params.items():
            ours = getattr(term, field)
            if isinstance(value, dict):
                assert ours == {axis: as_pair(pair) for axis, pair in value.items()}, (name, field)
            else:
                assert ours == as_pair(value), (name, field)


def as_pair(value):
    return tuple(value) if isinstance(value, list) else value


def test_observations(figures):
    assert list(CFG.observations) == list(figures["obs"])
    for group_name, reference in figures["obs"].items():
        group = CFG.observations[group_name]
        assert [name.removesuffix("_biased") for name in group.terms] == list(reference)
        for term_cfg, noise in zip(group.terms.values(), reference.values(), strict=True):
            if noise is None:
                assert term_cfg.noise is None
            else:
                assert noise["noise"] == "additive uniform"
                assert term_cfg.noise == UniformNoise(low=noise["min"], high=noise["max"])
            assert (term_cfg.scale, term_cfg.clip, term_cfg.delay, term_cfg.history) == (
                1.0,
                None,
                None,
                None,
            )
    assert CFG.observations["actor"].terms["joint_pos_biased"].term.biased
    assert not CFG.observations["critic"].terms["joint_pos"].term.biased


def test_actions_follow_the_joint_names(figures):
    (action,) = CFG.actions.values()
    assert list(action.joints) == figures["joint_names"]
    assert action.scale == figures["action_scale"]
    assert action.use_default_offset and action.clip is None
    assert CFG.scene.soft_joint_pos_limit_factor == figures["soft_joint_pos_limit_factor"]


def test_command_is_that_of_the_page():
    command = CFG.commands["twist"]
    assert (command.lin_vel_x, command.lin_vel_y, command.ang_vel_z) == ((-1, 1), (-1, 1), (-0.5, 0.5))
    assert command.resampling_time_range_s == (3, 8)
    assert (command.rel_standing_envs, command.rel_heading_envs, command.rel_forward_envs) == (0.1, 0.3, 0.2)
    assert (command.heading_stiffness, command.forward_min_speed) == (0.5, 0.3)
    assert CFG.episode_length_s == 20.0
    assert not CFG.is_finite_horizon and CFG.scale_rewards_by_dt


def test_training_defaults(figures):
    ppo, dataset = (
        figures["ppo"],
        TRAINING["data.num_env_states_per_minibatch"] * TRAINING["data.num_minibatches"],
    )
    assert dataset / TRAINING["num_envs"] == ppo["num_steps_per_env"]
    assert TRAINING["trainer.num_iterations"] == ppo["max_iterations"]
    assert TRAINING["seed"] == ppo["seed"]
    for network in ("actor", "critic"):
        for field in ("hidden_dims", "activation", "obs_normalization"):
            assert TRAINING[f"modules.{network}.{field}"] == ppo[network][field]
    for field in ("init_std", "std_type"):
        assert TRAINING[f"modules.actor.{field}"] == ppo["actor"]["distribution_cfg"][field]
    algorithm = ppo["algorithm"]
    names = {
        "num_learning_epochs": "objective.num_epochs",
        "num_mini_batches": "data.num_minibatches",
        "learning_rate": "objective.learning_rate",
        "schedule": "objective.schedule",
        "gamma": "objective.gamma",
        "lam": "objective.lmbda",
        "entropy_coef": "objective.entropy_coeff",
        "desired_kl": "objective.desired_kl",
        "max_grad_norm": "objective.max_grad_norm",
        "value_loss_coef": "objective.critic_coeff",
        "use_clipped_value_loss": "objective.clip_value",
        "clip_param": "objective.clip_epsilon",
    }
    for theirs, ours in names.items():
        assert TRAINING[ours] == algorithm[theirs], ours
    assert not algorithm["normalize_advantage_per_mini_batch"]
    assert TRAINING["objective.normalize_advantage"] == "dataset"


def test_model_has_the_physics_of_the_task(figures):
    loaded_spec(ROBOT)
    spec = build_spec(CFG.scene)
    CFG.sim.apply_to(spec)
    model = spec.compile()
    assert model.opt.timestep == figures["physics"]["timestep"]
    assert model.opt.impratio == figures["physics"]["impratio"]
    resolver = NameResolver(model, torch.device("cpu"))
    assert [resolver.names("joint")[i] for i in resolver.ids("joint", ROBOT.joint_names)] == figures[
        "joint_names"
    ]


@pytest.fixture(scope="module")
def env():
    loaded_spec(ROBOT)
    env = envs.make("go1_velocity_flat", num_envs=4, seed=3)
    yield env
    env.close()


def test_group_sizes_and_a_short_rollout(env, figures):
    for group, size in figures["obs_dims"].items():
        assert env.observation_spec[group].shape == (4, size)
    assert env.action_spec.shape == (4, len(figures["joint_names"]))
    rollout = env.rollout(6, break_when_any_done=False)
    assert torch.isfinite(rollout["next", "critic"]).all() and torch.isfinite(rollout["next", "reward"]).all()
    critic, bias = (
        rollout["obs", "joint_pos"],
        rollout["obs", "joint_pos_biased"] - rollout["obs", "joint_pos"],
    )
    assert critic.shape == (4, 6, 12)
    torch.testing.assert_close(bias, bias[:, :1].expand_as(bias), atol=1e-6, rtol=0)
    assert 0.0 < bias.abs().max() <= 0.015 + 1e-6


def test_zero_action_holds_the_stance(env):
    base = env.base_env
    env.set_seed(0)
    td = env.reset()
    for _ in range(25):
        td["action"] = torch.zeros(4, 12)
        td = env.step(td)["next"].exclude("reward")
    assert not td["done"].any()
    height = base.view.root_pos_EL[:, 2]
    assert (height > 0.2).all() and (height < 0.33).all()
    contact = base.view.contact("feet_ground_contact")
    assert contact.found_EN.sum() >= 12
    weight = 9.81 * base.world.mj_model.body_mass.sum()
    assert (-contact.force_EN3[..., 2].sum(-1) > 0.3 * weight).all()


def test_config_survives_the_trip_through_yaml():
    tree = envs.to_tree(CFG, envs.ManagerBasedRlEnvCfg)
    assert envs.from_tree(envs.ManagerBasedRlEnvCfg, tree) == CFG
    changed = envs.make_cfg("go1_velocity_flat", ["task.rewards.upright.weight=0.5"])
    assert changed.rewards["upright"] == dataclasses.replace(CFG.rewards["upright"], weight=0.5)
    assert changed.events == CFG.events
