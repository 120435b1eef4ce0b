"""States of the C engine are put into the worlds of an env, and what it makes of them is read."""

from collections.abc import Sequence

import numpy as np
import torch

from tests.suites.manipulation.truth import Moment


def tensor(states: Sequence[Moment], name: str) -> torch.Tensor:
    return torch.tensor(np.stack([getattr(state, name) for state in states]), dtype=torch.float32)


def injected(env, states: Sequence[Moment], *, command: str, joints):
    """Return observations and rewards by name, [E, L] and [E]; the env was reset."""
    inner = env.base_env
    world, view = inner.world, inner.view
    world.qpos_EL.copy_(tensor(states, "qpos"))
    world.qvel_EL.copy_(tensor(states, "qvel"))
    view.write_joint_pos_target(joints, tensor(states, "ctrl"))
    world.refresh()
    # Contacts and forces belong to the last substep, which is not in the state.
    model = world.mj_model
    for sensor in range(model.nsensor):
        if model.sensor(sensor).name.endswith("_found"):
            address = model.sensor_adr[sensor]
            world.sensordata_EL[:, address] = tensor(states, "sensordata")[:, address]
    world.actuator_force_EL.copy_(tensor(states, "actuator_force"))
    inner.command_manager.values[command].copy_(tensor(states, "wanted"))
    inner.driver.refreshed()
    everybody_E = torch.ones(len(states), dtype=torch.bool)
    inner.termination_manager.step(everybody_E)
    before_ER = inner.reward_manager.episode_sums_ER.clone()
    reward_E = inner.reward_manager.step(everybody_E)
    rewards_ER = inner.reward_manager.episode_sums_ER - before_ER
    torch.testing.assert_close(rewards_ER.sum(-1), reward_E, rtol=1e-4, atol=1e-4)
    return inner.observation_manager.read(), dict(
        zip(inner.reward_manager.names, rewards_ER.T, strict=True)
    )


def assert_near(found: torch.Tensor, expected: np.ndarray, name: str) -> None:
    """Each number is within 1e-5 (1 + |x|)."""
    error = np.abs(found.double().numpy() - expected) / (1.0 + np.abs(expected))
    assert found.shape == expected.shape and error.max() < 1e-5, (name, error.max())
