"""The course of rough velocity tasks: all kinds of ground at all levels, over which policies walk straight ahead.

It has the kinds of ground of a task at all of its levels, from a seed that no task has, and robots are spread evenly
over kinds and levels, where they stay. Each starts in the middle of its patch, turned as the task draws it, and is
commanded to walk straight ahead at 0.8 m/s and not to turn, for one episode of the time that this takes from edge to
edge (10 s on 8 m). Actions are deterministic; sensor noise, pushes and curricula are off, and models are drawn as in
training.

A robot succeeds if it gets as far from the middle as the curriculum asks for the next level (3.2 m of the 4 m to the
edge) and does not fall, be it before or after that. A fall is any end of an episode that is no truncation, which in
these tasks is a tilt beyond 70 degrees: a robot that sits on the ground has not fallen, but does not arrive either.
"""

import dataclasses
import statistics
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.mdp.commands.velocity import UniformVelocityCommand
from ksim_rl.mdp.curricula import TerrainLevels
from ksim_rl.mdp.events import PushByVelocity, ResetRootUniform
from ksim_rl.mdp.fields import distance_from_origin
from ksim_rl.scene.terrains import PatchedGround, TerrainGrid
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.evaluation import Evaluator
from ksim_rl.trainers.metrics import losses_of
from ksim_rl.trainers.run_folder import Policy, without_nan_guard

SPEED = 0.8
"""m/s ahead."""
GROUND_SEED, ROBOT_SEED = 1_000, 2_000
"""Of the ground, and of starts and drawn models."""
ENOUGH = 0.5
"""The share of robots that makes a level count."""


@dataclass(frozen=True, kw_only=True)
class Course:
    """The config of the env, and how far from the middle of its patch the root of `entity` has to get, m."""

    cfg: ManagerBasedRlEnvCfg
    distance: float
    entity: str

    @property
    def grid(self) -> TerrainGrid:
        """The ground, one column per kind."""
        assert isinstance(self.cfg.scene.terrain, TerrainGrid)
        return self.cfg.scene.terrain


@dataclass(frozen=True, kw_only=True)
class Outcomes:
    """What came of each robot: the index of its kind, its level, whether it got far enough, whether it fell, [E].

    And a line for each kind of contacts or constraints that the physics lost, and in how many worlds, at least.
    """

    kind_E: Tensor
    level_E: Tensor
    arrived_E: Tensor
    fell_E: Tensor
    lost: tuple[str, ...] = ()
    lost_worlds: int = 0


class Walk(Evaluator):
    """Runs one episode in each env; `arrived_E` is of these episodes only."""

    def __init__(self, base: ManagerBasedRlEnv, course: Course, **parts: Any) -> None:
        super().__init__(**parts)
        self._base, self._course = base, course
        self.arrived_E = torch.zeros_like(self._running_E)

    def _start(self) -> None:
        super()._start()
        self.arrived_E.zero_()

    def _count_one_step(self) -> None:
        super()._count_one_step()
        # Where an episode has just ended, the next one's start is there to be seen.
        away_E = distance_from_origin(self._base.view, self._course.entity)
        self.arrived_E.logical_or_(self._running_E & (away_E >= self._course.distance))


def course_of(cfg: ManagerBasedRlEnvCfg) -> Course:
    """Return the course of a rough velocity task.

    Raises:
        ValueError: if the task has no terrain in levels, or no velocity command that may ask for the course's speed.
    """
    grid = cfg.scene.terrain
    levels = next(
        (term for term in cfg.curriculum.values() if isinstance(term, TerrainLevels)), None
    )
    command = cfg.commands.get(levels.command) if levels else None
    if (
        levels is None
        or not isinstance(grid, TerrainGrid)
        or not isinstance(command, UniformVelocityCommand)
    ):
        raise ValueError(
            f"terrain={type(grid).__name__}, curriculum={sorted(cfg.curriculum)}: the course needs a TerrainGrid and a "
            "TerrainLevels of a UniformVelocityCommand: take a run of a task such as go1_velocity_rough"
        )
    check_in_range(
        "speed of the course", SPEED, low=command.lin_vel_x[0], high=command.lin_vel_x[1]
    )
    ahead = UniformVelocityCommand(
        resampling_time_range_s=command.resampling_time_range_s,
        lin_vel_x=(SPEED, SPEED),
        lin_vel_y=(0.0, 0.0),
        ang_vel_z=(0.0, 0.0),
        entity=command.entity,
    )
    ground = dataclasses.replace(
        grid,
        num_columns=len(grid.patches),  # one for each kind, whatever the proportions
        max_initial_level=grid.num_levels - 1,
        seed=GROUND_SEED,
    )
    events = {
        name: _in_the_middle(event) if isinstance(event, ResetRootUniform) else event
        for name, event in (cfg.events or {}).items()
        if not isinstance(event, PushByVelocity)
    }
    course = dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, terrain=ground),
        commands={**cfg.commands, levels.command: ahead},
        events=events,
        curriculum={},
        episode_length_s=grid.size / SPEED,
    )
    return Course(cfg=course, distance=levels.up_distance * grid.size / 2, entity=levels.entity)


def _in_the_middle(event: ResetRootUniform) -> ResetRootUniform:
    return dataclasses.replace(
        event, pose_range={**event.pose_range, "x": (0.0, 0.0), "y": (0.0, 0.0)}
    )


def walk(policy: Policy, course: Course, *, num_envs: int) -> Outcomes:
    """Let the policy walk one episode in each of `num_envs` envs.

    Raises:
        ValueError: if these are fewer than the patches of ground.
    """
    grid = course.grid
    if num_envs < grid.num_levels * grid.num_columns:
        raise ValueError(
            f"num_envs={num_envs}: the course has {grid.num_levels} levels of {grid.num_columns} kinds: choose at "
            f"least {grid.num_levels * grid.num_columns}"
        )
    cfg = without_nan_guard(dataclasses.replace(policy.cfg, task=course.cfg))
    env = build_env(cfg, num_envs=num_envs, seed=ROBOT_SEED)
    env.eval()
    base = part(env, ManagerBasedRlEnv)
    assert base is not None  # the env of a config is ours
    runner = Walk(
        base,
        course,
        env=env,
        policy=policy.actor,
        max_steps=base.max_episode_length,
        seed=ROBOT_SEED,
    )
    runner()
    losses = losses_of(env)
    ground = base.view.terrain
    assert isinstance(ground, PatchedGround)  # what a TerrainGrid makes
    # Patches are numbered level by level, with all columns in each.
    kind_E = ground.patches_E - ground.levels_E * grid.num_columns
    of_env = (kind_E, ground.levels_E, runner.arrived_E, runner.terminated_E)
    kind_E, level_E, arrived_E, fell_E = (figure_E.cpu() for figure_E in of_env)
    env.close(raise_if_closed=False)
    return Outcomes(
        kind_E=kind_E,
        level_E=level_E,
        arrived_E=arrived_E,
        fell_E=fell_E,
        lost=losses.lines,
        lost_worlds=losses.worlds,
    )


def summary(
    outcomes: Outcomes, *, kinds: tuple[str, ...], num_levels: int
) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Return the share of successes by kind and level, and the figures of each kind and of all."""
    success_E = outcomes.arrived_E & ~outcomes.fell_E
    success_by_level: dict[str, list[float]] = {}
    figures: dict[str, float] = {}
    for index, kind in enumerate(kinds):
        cells = [
            (outcomes.kind_E == index) & (outcomes.level_E == level) for level in range(num_levels)
        ]
        success, fell = (
            [float(figure_E[cell_E].double().mean()) for cell_E in cells]
            for figure_E in (success_E, outcomes.fell_E)
        )
        success_by_level[kind] = success
        figures[f"{kind}/success"] = statistics.fmean(success)
        figures[f"{kind}/fell"] = statistics.fmean(fell)
        hardest = (level for level, share in enumerate(success) if share < ENOUGH)
        figures[f"{kind}/levels"] = next(hardest, num_levels)
    for name in ("success", "fell", "levels"):
        figures[name] = statistics.fmean(figures[f"{kind}/{name}"] for kind in kinds)
    return success_by_level, figures
