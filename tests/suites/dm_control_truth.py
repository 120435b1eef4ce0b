"""dm_control's own tasks, as the truth: each step's state, observations and reward."""

import dataclasses
import warnings

import mujoco
import numpy as np
import pytest


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moment:
    """A state of a task of dm_control with what the task makes of it."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    sensordata: np.ndarray
    target: np.ndarray | None
    observations: dict[str, np.ndarray]
    reward: float


def load(domain: str, task: str):
    """Load a task; mujoco 4 lacks nine arrays of models that the sizes of dm_control 1.0.50 name."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # glfw warns where there is no display
        pytest.importorskip("dm_control")
        from dm_control import suite
        from dm_control.mujoco.wrapper.mjbindings import sizes
    for struct in (mujoco.MjModel, mujoco.MjData):
        table = sizes.array_sizes[struct.__name__.lower()]
        for name in [name for name in table if name.startswith(("flex_vert", "flexvert_"))]:
            if not hasattr(struct, name):
                del table[name]
    return suite.load(domain, task, task_kwargs={"random": 1})


def moments(domain: str, task: str, *, count: int, every: int) -> list[Moment]:
    """Let random actions move the task, and return a state every so many control steps."""
    env, random = load(domain, task), np.random.default_rng(0)
    spec, found = env.action_spec(), []
    env.reset()
    for step in range(count * every):
        # Held for a while, so that something happens.
        if step % 5 == 0:
            action = random.uniform(spec.minimum, spec.maximum)
        time_step = env.step(action)
        if (step + 1) % every == 0:
            found.append(_moment(env, time_step))
    return found


def _moment(env, time_step) -> Moment:
    physics = env.physics
    return Moment(
        qpos=physics.data.qpos.copy(),
        qvel=physics.data.qvel.copy(),
        ctrl=physics.data.ctrl.copy(),
        sensordata=physics.data.sensordata.copy(),
        target=_target(physics),
        observations={
            name: np.atleast_1d(value).copy() for name, value in time_step.observation.items()
        },
        reward=time_step.reward,
    )


def _target(physics) -> np.ndarray | None:
    model, data = physics.model.ptr, physics.data.ptr
    for kind, poses in (
        (mujoco.mjtObj.mjOBJ_GEOM, data.geom_xpos),
        (mujoco.mjtObj.mjOBJ_SITE, data.site_xpos),
    ):
        index = mujoco.mj_name2id(model, kind, "target")
        if index >= 0:
            return poses[index].copy()
    return None
