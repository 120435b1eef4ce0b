"""The tasks of the DeepMind Control Suite against dm_control's own: models, observations, rewards, starts."""

import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.suites.dm_control.tasks import SUITE_TASKS, domain_of
from tests.suites.dm_control_truth import load, moments

# Models that compile fast, one of them built in Python; the others in full runs.
QUICK = ("cartpole_balance", "pendulum_swingup", "swimmer_swimmer6")
TASKS = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in SUITE_TASKS
]
COUNT = 8


def dm_names(name: str) -> tuple[str, str]:
    domain = domain_of(name)
    return domain, name.removeprefix(f"{domain}_")


def injected(env, states):
    """Put states of dm_control into the worlds of an env that was reset; return what it observes and rewards."""
    inner = env.base_env
    world = inner.world

    def tensor(name):
        return torch.tensor(
            np.stack([getattr(state, name) for state in states]), dtype=torch.float32
        )

    world.qpos_EL.copy_(tensor("qpos"))
    world.qvel_EL.copy_(tensor("qvel"))
    world.ctrl_EL.copy_(tensor("ctrl"))
    world.refresh()
    # Touch sensors belong to the last substep of dm_control's step, which is not in the state.
    touch = [
        i
        for i in range(world.mj_model.nsensor)
        if world.mj_model.sensor(i).name.startswith("touch")
    ]
    for sensor in touch:
        address = world.mj_model.sensor_adr[sensor]
        world.sensordata_EL[:, address] = tensor("sensordata")[:, address]
    if "target" in inner.command_manager.values:
        inner.command_manager.values["target"].copy_(tensor("target"))
    inner.driver.refreshed()
    observations = inner.observation_manager.read()
    rewards = inner.reward_manager.step(torch.ones(len(states), dtype=torch.bool))
    return observations, rewards


@pytest.mark.parametrize("name", TASKS)
def test_it_is_the_task_of_dm_control(name):
    env = envs.make(f"dm_control_{name}", num_envs=COUNT, seed=0)
    has_the_model_and_time_steps_of(env, load(*dm_names(name)))
    observes_and_rewards_as(env, moments(*dm_names(name), count=COUNT, every=25))
    env.close()


def has_the_model_and_time_steps_of(env, theirs):
    theirs.reset()  # it sets the damping of the finger
    ours, model = env.base_env.world.mj_model, theirs.physics.model
    for field in (
        "body_mass",
        "body_inertia",
        "dof_damping",
        "dof_armature",
        "jnt_range",
        "qpos0",
        "actuator_gear",
    ):
        np.testing.assert_allclose(
            getattr(ours, field), getattr(model, field), atol=1e-9, err_msg=field
        )
    assert ours.opt.timestep == model.opt.timestep and ours.opt.integrator == model.opt.integrator
    assert ours.opt.disableflags == model.opt.disableflags
    assert env.base_env.step_dt == pytest.approx(theirs.control_timestep())
    assert env.base_env.max_episode_length == 1000
    assert env.base_env.action_spec.shape[-1] == theirs.action_spec().shape[0]


def observes_and_rewards_as(env, states):
    env.reset()
    observations, reward_E = injected(env, states)
    ours_EL = torch.cat(list(observations.values()), dim=-1).double().numpy()
    theirs_EL = np.stack(
        [np.concatenate([v.ravel() for v in s.observations.values()]) for s in states]
    )
    assert ours_EL.shape == theirs_EL.shape
    error_EL = np.abs(ours_EL - theirs_EL) / (1.0 + np.abs(theirs_EL))
    assert error_EL.max() < 1e-5, list(observations)
    reward_of_theirs = np.array([state.reward for state in states])
    error_E = np.abs(reward_E.double().numpy() - reward_of_theirs) / (1.0 + reward_of_theirs)
    assert error_E.max() < 1e-5
