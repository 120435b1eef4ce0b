"""The course is the same for all policies, spread evenly, and counts those who get across on their feet."""

import dataclasses
from dataclasses import dataclass

import pytest
import torch

from ksim_rl import conf, envs
from ksim_rl.envs import EventTerm, mdp
from ksim_rl.scene.terrains import FlatPatch, PyramidSlope, TerrainGrid
from ksim_rl.tasks.rough_ground import on_rough_ground
from ksim_rl.tasks.terrain_course import Outcomes, course_of, summary, walk
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.run_folder import Policy

KINDS = {"flat": FlatPatch(cell=1.0), "slope_down": PyramidSlope(proportion=5.0, cell=0.5)}
NUM_ENVS = 14


@pytest.fixture(scope="module")
def untrained():
    """A new policy of our quadruped on two kinds of ground in three levels."""
    cfg = conf.compose(["task=quadruped_velocity_flat", "num_envs=4", "device=cpu"])
    task = on_rough_ground(cfg.task, root_height=0.3, njmax=120, nconmax=40)
    grid = TerrainGrid(patches=KINDS, num_levels=3, num_columns=4)
    cfg = dataclasses.replace(
        cfg, task=dataclasses.replace(task, scene=dataclasses.replace(task.scene, terrain=grid))
    )
    env = build_env(cfg, num_envs=1, seed=0)
    torch.manual_seed(0)
    actor = make_policy(cfg, env)
    env.close()
    return Policy(cfg=cfg, actor=actor, iteration=0)


@dataclass(frozen=True, kw_only=True)
class Throw(EventTerm):
    """Let each robot's first episode begin with another velocity than its later ones."""

    first: mdp.ResetRootUniform
    later: mdp.ResetRootUniform

    def __call__(self, view, mask_E):
        # The reset that is under way is counted already.
        self.first(view, mask_E & (view.reset_count_E == 1))
        self.later(view, mask_E & (view.reset_count_E > 1))


# m/s and rad/s. 3.2 m take 0.53 s, and who rises at 4 m/s is in the air for 0.8 s; 70 degrees take 0.25 s.
UPRIGHT, TURNING, SOME = (
    mdp.ResetRootUniform(velocity_range={"x": (6.0, 6.0), "z": (4.0, 4.0), "roll": roll})
    for roll in ((0.0, 0.0), (5.0, 5.0), (0.0, 5.0))
)


def throw(policy, first, later):
    """Walk the course with robots that are thrown."""
    course = course_of(policy.cfg.task)
    events = {**course.cfg.events, "reset_base": Throw(first=first, later=later)}
    thrown = dataclasses.replace(course, cfg=dataclasses.replace(course.cfg, events=events))
    return walk(policy, thrown, num_envs=NUM_ENVS)


def test_robots_that_walk_without_room_for_their_contacts_are_counted(untrained):
    course = course_of(untrained.cfg.task)
    cfg = dataclasses.replace(course.cfg, episode_length_s=0.4)
    short = dataclasses.replace(course, cfg=cfg)
    assert walk(untrained, short, num_envs=NUM_ENVS).lost_worlds == 0
    cfg = dataclasses.replace(cfg, sim=dataclasses.replace(cfg.sim, njmax=30))
    tight = dataclasses.replace(course, cfg=cfg)
    outcomes = walk(untrained, tight, num_envs=NUM_ENVS)
    # They land on four feet within the time.
    assert 1 <= outcomes.lost_worlds <= NUM_ENVS
    assert "constraint rows needed" in outcomes.lost[0]


def test_the_course_of_go1_asks_for_one_speed_and_pushes_nobody():
    task = envs.task("go1_velocity_rough").cfg()
    course = course_of(task)
    assert (
        course.grid.columns == tuple(task.scene.terrain.patches) and len(course.grid.columns) == 8
    )
    assert course.grid.seed != task.scene.terrain.seed and course.grid.num_levels == 10
    assert course.distance == pytest.approx(3.2) and course.cfg.episode_length_s == pytest.approx(
        10.0
    )
    assert task.events.keys() - course.cfg.events.keys() == {"push_robot"}
    command = course.cfg.commands["twist"]
    ranges = (command.lin_vel_x, command.lin_vel_y, command.ang_vel_z)
    assert ranges == ((0.8, 0.8), (0.0, 0.0), (0.0, 0.0))
    assert not (command.rel_standing_envs or command.rel_heading_envs or command.rel_forward_envs)
    start = course.cfg.events["reset_base"].pose_range
    assert (start["x"], start["y"]) == ((0.0, 0.0), (0.0, 0.0)) and not course.cfg.curriculum


def test_a_task_without_levels_or_of_other_speeds_is_refused():
    with pytest.raises(ValueError, match="go1_velocity_rough"):
        course_of(envs.task("go1_velocity_flat").cfg())
    task = envs.task("go1_velocity_rough").cfg()
    slow = dataclasses.replace(task.commands["twist"], lin_vel_x=(-0.5, 0.5))
    with pytest.raises(ValueError, match=r"speed of the course=0\.8"):
        course_of(dataclasses.replace(task, commands={"twist": slow}))


@pytest.mark.full
def test_robots_are_spread_evenly_and_an_untrained_policy_gets_nowhere(untrained):
    course = course_of(untrained.cfg.task)
    outcomes = walk(untrained, course, num_envs=NUM_ENVS)
    assert outcomes.kind_E.tolist() == [0] * 7 + [1] * 7
    assert outcomes.level_E.tolist() == [0, 1, 2, 0, 1, 2, 0] * 2
    assert not outcomes.arrived_E.any()
    with pytest.raises(ValueError, match="choose at least 6"):
        walk(untrained, course, num_envs=5)


@pytest.mark.full
def test_what_is_drawn_does_not_depend_on_the_seed_of_the_run(untrained):
    one, other = (
        throw(
            dataclasses.replace(untrained, cfg=dataclasses.replace(untrained.cfg, seed=seed)),
            SOME,
            SOME,
        )
        for seed in (1, 2)
    )
    assert 0 < int(one.fell_E.sum()) < NUM_ENVS
    for name in ("kind_E", "level_E", "arrived_E", "fell_E"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


@pytest.mark.full
def test_who_flies_across_arrives_and_who_turns_over_on_the_way_has_fallen(untrained):
    """What counts is the first episode; many more of the other kind follow."""
    upright = throw(untrained, UPRIGHT, TURNING)
    assert upright.arrived_E.all() and not upright.fell_E.any()
    turning = throw(untrained, TURNING, UPRIGHT)
    assert turning.fell_E.all() and not turning.arrived_E.any()


def test_success_is_to_arrive_and_not_to_fall_and_a_level_counts_after_all_easier_ones():
    # Of kind a: level 0: both succeed; 1: one arrives and falls; 2: both succeed. Of b: nobody arrives, one falls.
    outcomes = Outcomes(
        kind_E=torch.tensor([0] * 6 + [1] * 6),
        level_E=torch.tensor([0, 1, 2] * 4),
        arrived_E=torch.tensor([1, 1, 1, 1, 0, 1] + [0] * 6, dtype=torch.bool),
        fell_E=torch.tensor([0, 1, 0, 0, 0, 0] + [0, 0, 0, 0, 0, 1], dtype=torch.bool),
    )
    success_by_level, figures = summary(outcomes, kinds=("a", "b"), num_levels=3)
    assert success_by_level == {"a": [1.0, 0.0, 1.0], "b": [0.0, 0.0, 0.0]}
    assert figures == pytest.approx(
        {
            "a/success": 2 / 3,
            "a/fell": 1 / 6,
            "a/levels": 1,
            "b/success": 0.0,
            "b/fell": 1 / 6,
            "b/levels": 0,
            "success": 1 / 3,
            "fell": 1 / 6,
            "levels": 0.5,
        }
    )
