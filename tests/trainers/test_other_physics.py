"""What judges a run that the C engine trained is other physics, and the words say which."""

import dataclasses

import pytest

from ksim_rl import conf
from ksim_rl.scene.actuators import DelayedActuator
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.other_physics import judged_by
from tests.scene.robots.reference import loaded_spec


@pytest.fixture(scope="module")
def by_c() -> RunCfg:
    cfg = conf.compose(["task=go1_velocity_flat", "num_envs=64", "task.sim.engine=c"])
    loaded_spec(cfg.task.scene.robots["go1"])
    return cfg


def test_a_run_of_warp_is_judged_as_it_is(by_c):
    judged, words = judged_by(by_c, trained="warp")
    assert judged is by_c
    assert words == "on MuJoCo's C engine (trained on MuJoCo Warp)"


def test_a_run_of_c_gets_another_integrator_and_half_the_time_step(by_c):
    judged, words = judged_by(by_c, trained="c")
    assert (by_c.task.sim.integrator, by_c.task.sim.timestep) == ("implicitfast", 0.005)
    assert (judged.task.sim.integrator, judged.task.sim.timestep) == ("euler", 0.0025)
    assert judged.task.decimation == 2 * by_c.task.decimation
    assert (
        "integrator euler instead of implicitfast, with a time step of 0.0025 s instead of 0.005 s"
        in words
    )


def test_what_the_user_sets_stays(by_c):
    judged, words = judged_by(by_c, trained="c", given=["task.sim.integrator", "task.sim.timestep"])
    assert judged == by_c
    assert "with the integrator and the time step that were given" in words


def test_lags_in_substeps_keep_the_time_step(by_c):
    ((name, robot),) = by_c.task.scene.robots.items()
    late = [DelayedActuator(actuator=actuator, max_lag=2) for actuator in robot.actuators]
    assert late
    robots = {name: dataclasses.replace(robot, actuators=late)}
    scene = dataclasses.replace(by_c.task.scene, robots=robots)
    cfg = dataclasses.replace(by_c, task=dataclasses.replace(by_c.task, scene=scene))
    judged, words = judged_by(cfg, trained="c")
    assert judged.task.decimation == cfg.task.decimation
    assert "its time step of 0.005 s, in which its actuators count their lags" in words
