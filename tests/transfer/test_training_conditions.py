"""The conditions of a policy's training are described in the words of its task."""

import dataclasses

from ksim_rl.envs import mdp
from ksim_rl.tasks.velocity_flat import quadruped_velocity_flat
from ksim_rl.transfer.training_conditions import training_conditions


def test_what_differs_from_defaults_is_told():
    cfg = quadruped_velocity_flat()
    push = mdp.PushByVelocity(interval_range_s=(1.0, 2.0), velocity_range={"x": (-0.3, 0.3)})
    found = training_conditions(dataclasses.replace(cfg, decimation=3, events={"push": push}))
    assert found["physics"] == "3 steps of 5 ms to an action"
    assert found["motors"] == "PositionActuator"
    assert found["observation base_ang_vel"] == "UniformNoise(low=-0.2, high=0.2)"
    told = "PushByVelocity(interval_range_s=(1.0, 2.0), velocity_range={'x': (-0.3, 0.3)})"
    assert found["event push"] == told
