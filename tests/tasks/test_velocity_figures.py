"""Compares every figure of the reference tasks with the configs; each that is read is ticked off, none may be left."""

import ast
import re

import pytest

from ksim_rl import envs
from ksim_rl.transforms.noise.cfg import UniformNoise
from tests.scene.robots.reference import reference_figures

# The robot that each task has in the reference.
TASKS = {"go1_velocity_flat": "unitree_go1", "g1_velocity_flat": "unitree_g1"}
SENSORS = {"robot/root_angmom": "root_angmom"}
FIELDS = {"sensor_name": "sensor", "command_name": "command", "force_threshold": "threshold"}


class Reference:
    def __init__(self, task):
        self.task = envs.task(task)
        self.cfg = self.task.cfg()
        self.figures = reference_figures(TASKS[task])
        (self.robot,) = self.cfg.scene.robots.values()

    def by_joint(self, table):
        """Spread a table of patterns over the robot's joints, as the reference's search for matches does."""
        return {
            name: value
            for name in self.robot.joint_names
            for pattern, value in table.items()
            if re.fullmatch(pattern, name)
        }


@pytest.fixture(scope="module", params=TASKS)
def ref(request):
    return Reference(request.param)


def as_pair(value):
    return tuple(value) if isinstance(value, list) else value


def test_physics(ref):
    physics = dict(ref.figures["physics"])
    assert physics.pop("decimation") == ref.cfg.decimation
    for name, value in physics.items():
        assert getattr(ref.cfg.sim, name) == value, name


def test_rewards(ref):
    assert list(ref.cfg.rewards) == list(ref.figures["rewards"])
    for name, reference in ref.figures["rewards"].items():
        term, params = ref.cfg.rewards[name], dict(reference["params"])
        assert term.weight == reference["weight"], name
        # On flat ground we take the heights of the foot sites, which a ray sensor reads in the reference.
        if params.pop("height_sensor_name", None):
            assert term.sites == ref.robot.foot_sites
        for field, value in params.items():
            ours = getattr(term, FIELDS.get(field, field))
            if isinstance(value, dict):
                assert ref.by_joint(ours) == ref.by_joint(value), (name, field)
                assert len(ref.by_joint(ours)) == len(ref.robot.joint_names)
            elif isinstance(value, str):
                assert ours == SENSORS.get(value, value), (name, field)
            else:
                assert ours == pytest.approx(value, rel=1e-12), (name, field)


def test_the_torso_is_what_stays_upright_and_calm(ref):
    torso = {"go1": "trunk", "g1": "torso_link"}[ref.robot.name]
    assert (ref.cfg.rewards["upright"].body or ref.robot.root_body) == torso
    assert ref.cfg.rewards["body_ang_vel"].body == torso
    assert tuple(ref.cfg.events["base_com"].elements) == (torso,)


def test_feet_are_read_in_each_physics_step(ref):
    assert ref.cfg.scene.sensors["feet_ground_contact"].every_substep


def test_commands_become_faster_as_in_the_reference(ref):
    # mjlab 1.6.0: 5,000 and 10,000 iterations of 24 steps; its first stage, at step 0, is the command's own ranges.
    curriculum = ref.cfg.curriculum["command_ranges"]
    assert curriculum.command == "twist"
    assert curriculum.stages == {
        120_000: {"lin_vel_x": (-1.5, 2.0), "ang_vel_z": (-0.7, 0.7)},
        240_000: {"lin_vel_x": (-2.0, 3.0)},
    }


def test_terminations(ref):
    assert list(ref.cfg.terminations) == list(ref.figures["terminations"])
    for name, reference in ref.figures["terminations"].items():
        term = ref.cfg.terminations[name]
        assert term.time_out == reference["time_out"]
        for field, value in reference["params"].items():
            assert getattr(term, field) == pytest.approx(float(value), rel=1e-12)


def test_events(ref):
    assert set(ref.cfg.events) == set(ref.figures["events"])
    for name, reference in ref.figures["events"].items():
        term, params = ref.cfg.events[name], dict(reference["params"])
        assert term.mode == reference["mode"], name
        assert term.interval_range_s == as_pair(reference["interval_range_s"]), name
        of = params.pop("of", None)
        if of == "all joints":
            assert term.joints == ".*"
        elif of is not None:
            # Long lists are cut off in the figures, after a comma.
            listed = ast.literal_eval(of if of.endswith(")") else of + ")")
            assert tuple(term.elements)[: len(listed)] == listed
            assert len(term.elements) == len(listed) or not of.endswith(")")
        axes = params.pop("axes", [0])
        ranges = params.pop("ranges", None)
        if isinstance(ranges, list):
            assert term.ranges == {axes[0]: as_pair(ranges)}, name
        elif ranges is not None:
            assert term.ranges == {int(axis): as_pair(pair) for axis, pair in ranges.items()}
        if "shared_random" in params:
            assert params.pop("shared_random") == term.shared
            assert params.pop("distribution", "uniform") == term.distribution
        for field, value in params.items():
            ours = getattr(term, "ranges" if field == "bias_range" else field)
            if isinstance(value, dict):
                assert ours == {axis: as_pair(pair) for axis, pair in value.items()}, (name, field)
            else:
                assert ours == as_pair(value), (name, field)


def test_observations(ref):
    observations = ref.cfg.observations
    assert list(observations) == list(ref.figures["obs"])
    for group_name, reference in ref.figures["obs"].items():
        group = observations[group_name]
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
    assert observations["actor"].terms["joint_pos_biased"].term.biased
    assert not observations["critic"].terms["joint_pos"].term.biased


def test_actions_follow_the_joint_names(ref):
    (action,) = ref.cfg.actions.values()
    assert list(action.joints) == ref.figures["joint_names"]
    assert action.scale == ref.figures["action_scale"]
    assert action.use_default_offset and action.clip is None
    assert ref.cfg.scene.soft_joint_pos_limit_factor == ref.figures["soft_joint_pos_limit_factor"]


def test_command_is_that_of_the_page(ref):
    command = ref.cfg.commands["twist"]
    assert (command.lin_vel_x, command.lin_vel_y, command.ang_vel_z) == (
        (-1, 1),
        (-1, 1),
        (-0.5, 0.5),
    )
    assert command.resampling_time_range_s == (3, 8)
    assert (command.rel_standing_envs, command.rel_heading_envs, command.rel_forward_envs) == (
        0.1,
        0.3,
        0.2,
    )
    assert (command.heading_stiffness, command.forward_min_speed) == (0.5, 0.3)
    assert ref.cfg.episode_length_s == 20.0
    assert not ref.cfg.is_finite_horizon and ref.cfg.scale_rewards_by_dt


def test_training_defaults(ref):
    ppo, training = ref.figures["ppo"], ref.task.training
    assert training.data.num_env_states / training.num_envs == ppo["num_steps_per_env"]
    assert training.trainer.num_iterations == ppo["max_iterations"]
    assert training.seed == ppo["seed"]
    actor, critic, objective = training.modules.actor, training.modules.critic, training.objective
    for name, network in (("actor", actor), ("critic", critic)):
        assert list(network.hidden_dims) == ppo[name]["hidden_dims"]
        for field in ("activation", "obs_normalization"):
            assert getattr(network, field) == ppo[name][field]
    spread = ppo["actor"]["distribution_cfg"]
    assert actor.std_type == spread["std_type"]
    algorithm = ppo["algorithm"]
    names = {
        "num_learning_epochs": "num_epochs",
        "learning_rate": "learning_rate",
        "schedule": "schedule",
        "lam": "lmbda",
        "entropy_coef": "entropy_coeff",
        "desired_kl": "desired_kl",
        "max_grad_norm": "max_grad_norm",
        "value_loss_coef": "critic_coeff",
        "use_clipped_value_loss": "clip_value",
        "clip_param": "clip_epsilon",
    }
    for theirs, ours in names.items():
        assert getattr(objective, ours) == algorithm[theirs], ours
    assert training.data.num_minibatches == algorithm["num_mini_batches"]
    # Ours on purpose; see `velocity_training.training`, and docs/notes/g1.md for G1.
    assert (algorithm["gamma"], spread["init_std"]) == (0.99, 1.0)
    own = {"go1_velocity_flat": (0.98, 1.0), "g1_velocity_flat": (0.99, 0.5)}
    assert (objective.gamma, actor.init_std) == own[ref.task.name]
    assert not algorithm["normalize_advantage_per_mini_batch"]
    assert objective.normalize_advantage == "dataset"
