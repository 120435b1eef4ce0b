"""Terms that read or move a root do so for the entity that they name, and for no other."""

import math

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.envs import MjcfRobot, SceneCfg
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.physics import load_model
from ksim_rl.scene.scene import build_spec
from tests.mdp.bench import FREE_BODY, Bench

SCENE = SceneCfg(robots={"one": MjcfRobot(source=FREE_BODY), "two": MjcfRobot(source=FREE_BODY)})
# Two is turned by 90 degrees about z, tilted by nothing, 5 m away and moves along world x and turns.
HALF = math.sqrt(0.5)
ONE, TWO = (0, 0, 1, 1, 0, 0, 0, 0, 0), (3, 4, 0.2, HALF, 0, 0, HALF, 0, 0)
ONE_VEL, TWO_VEL = (0,) * 8, (6, 0, 0, 0, 0, 8, 0, 0)


@pytest.fixture
def pair():
    bench = Bench(FREE_BODY, 2, {})
    spec = build_spec(SCENE)
    bench.world = type(bench.world)(load_model(spec), num_envs=2)
    bench.driver = EnvDriver(bench.world, step_dt=0.02, entities=tuple(SCENE.entities))
    bench.view = bench.driver.view
    bench.place(qpos=(*ONE, *TWO), qvel=(*ONE_VEL, *TWO_VEL))
    return bench


def states(bench):
    """Return the states of one and of two, each [E, nq + nv of it]."""
    qpos, qvel = bench.world.qpos_EL.clone(), bench.world.qvel_EL.clone()
    return torch.cat((qpos[:, :9], qvel[:, :8]), -1), torch.cat((qpos[:, 9:], qvel[:, 8:]), -1)


@pytest.mark.parametrize(
    "event",
    [
        mdp.ResetRootUniform(pose_range={"x": (1.0, 2.0)}, entity="two"),
        mdp.PushByVelocity(
            velocity_range={"x": (1.0, 2.0)}, entity="two", interval_range_s=(1.0, 1.0)
        ),
        mdp.Jump(height_range=(1.0, 2.0), entity="two", interval_range_s=(1.0, 1.0)),
        mdp.ResetHeading(heading_range=(-1.0, 1.0), entity="two"),
        mdp.ResetHeight(height_range=(1.0, 2.0), entity="two"),
    ],
    ids=lambda event: type(event).__name__,
)
def test_events_move_the_entity_that_they_name(pair, event):
    one, two = states(pair)
    pair.fire(event)
    assert torch.equal(states(pair)[0], one) and not torch.equal(states(pair)[1], two)


@pytest.mark.parametrize(
    "term",
    [
        lambda entity: mdp.RootHeightBelow(minimum_height=0.5, entity=entity),
        lambda entity: mdp.FarFromOrigin(distance=4.5, entity=entity),
        lambda entity: mdp.RootVelocityAbove(linear=5.0, entity=entity),
        lambda entity: mdp.RootVelocityAbove(angular=7.0, entity=entity),
    ],
)
def test_terminations_watch_the_entity_that_they_name(pair, term):
    for entity, ends in (("", False), ("one", False), ("two", True)):
        assert pair.read(term(entity), "terminations/x").tolist() == [ends] * 2


def test_a_tilt_counts_for_its_entity(pair):
    pair.place(qpos=(*ONE, 0, 0, 1, HALF, HALF, 0, 0, 0, 0))
    for entity, ends in (("", False), ("two", True)):
        term = mdp.BadOrientation(limit_angle=1.0, entity=entity)
        assert pair.read(term, "terminations/x").tolist() == [ends] * 2


def test_metrics_and_commands_are_of_their_entity(pair):
    pair.command([0.0, -3.0, 2.0])
    # In its own frame, two moves at (0, -6).
    for entity, linear, angular in (("", 3.0, 2.0), ("two", 3.0, 6.0)):
        error = mdp.LinearVelocityError(command="twist", entity=entity)
        assert pair.read(error, "metrics/x").tolist() == pytest.approx([linear] * 2, abs=1e-5)
        error = mdp.AngularVelocityError(command="twist", entity=entity)
        assert pair.read(error, "metrics/x").tolist() == pytest.approx([angular] * 2, abs=1e-5)
    start = mdp.StartPoseCommand(entity="two")
    with pair.driver.scope("commands/start"):
        start.resample(pair.view, pair.everybody_E)
        assert start(pair.view)[0].tolist() == pytest.approx(list(TWO[:7]), abs=1e-6)


def test_a_heading_command_steers_its_entity(pair):
    term = mdp.UniformVelocityCommand(
        resampling_time_range_s=(1.0, 1.0),
        lin_vel_x=(0.0, 0.0),
        lin_vel_y=(0.0, 0.0),
        ang_vel_z=(-9.0, 9.0),
        heading=(0.0, 0.0),
        heading_stiffness=1.0,
        rel_heading_envs=1.0,
        entity="two",
    )
    with pair.driver.scope("commands/twist"):
        term.resample(pair.view, pair.everybody_E)
        assert term(pair.view)[:, 2].tolist() == pytest.approx([-math.pi / 2] * 2, abs=1e-5)


def test_an_unknown_entity_is_refused_with_the_near_names(pair):
    with pytest.raises(
        ValueError, match="no entity 'tow' in scene.robots and scene.objects: did you mean 'two'"
    ):
        pair.read(mdp.RootHeightBelow(minimum_height=0.5, entity="tow"), "terminations/x")
