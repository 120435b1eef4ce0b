"""Chooses and describes the physics in which a trained policy is judged, other than the physics of its training."""

import dataclasses
from collections.abc import Collection
from typing import Any, Literal

import mujoco

from ksim_rl.config.trees import Tree
from ksim_rl.envs import ManagerBasedRlEnvCfg
from ksim_rl.physics import SimCfg
from ksim_rl.scene.scene import scene_spec
from ksim_rl.trainers.run_cfg import RunCfg

ENGINES = {"auto": "the engine that suits", "warp": "MuJoCo Warp", "c": "MuJoCo's C engine"}
PREFIX = "task.sim."
ENGINE = f"{PREFIX}engine"
# The integrator that judges runs of any other integrator.
_OTHER_INTEGRATOR = {"euler": "implicitfast", "discrete": "implicitfast"}


def trained_with(tree: Tree) -> Literal["auto", "warp", "c"]:
    """Return the engine that made a run, from its tree of config; those that name none were made by Warp."""
    sim: Tree = tree.get("task", {}).get("sim", {})
    return sim.get("engine", "warp")


def in_c_engine(sim: SimCfg) -> SimCfg:
    """Return the settings of a simulation for MuJoCo's C engine, which has no kernels of ours."""
    return dataclasses.replace(sim, engine="c", one_kernel_dynamics=None)


def check_physics_alone(fields: Collection[str], command: str) -> None:
    """Refuse fields that change more of a run's config than how its worlds are simulated."""
    for field in fields:
        if not field.startswith(PREFIX):
            raise ValueError(
                f"{field}: `ksim-rl {command}` changes only how worlds are simulated, {PREFIX}*: see the policy "
                f"under another config by ksim-rl play RUN {field}=..."
            )


def judged_by(cfg: RunCfg, *, trained: str, given: Collection[str] = ()) -> tuple[RunCfg, str]:
    """Return the config with which `cfg.task.sim.engine` judges a run, and words that say which physics that is.

    The C engine judges a run of MuJoCo Warp as it is configured. A run that the C engine itself trained would meet what
    it knows: it is judged with another integrator, and with half the time step and twice the substeps, unless `given`,
    the fields that the user sets, have these.
    """
    engine = cfg.task.sim.engine
    if engine != trained or engine != "c":
        return cfg, f"on {ENGINES[engine]} (trained on {ENGINES[trained]})"
    changes, words = _changes(cfg.task, given)
    # Half the time step needs twice the substeps, so that an env step lasts as long as in training.
    sim = dataclasses.replace(cfg.task.sim, **changes)
    decimation = cfg.task.decimation
    if "timestep" in changes:
        decimation = 2 * decimation
    task = dataclasses.replace(cfg.task, sim=sim, decimation=decimation)
    said = ", ".join(words) or "with the integrator and the time step that were given"
    return dataclasses.replace(cfg, task=task), f"on {ENGINES[engine]}, which trained it, {said}"


def other_integrator(option: mujoco.MjOption) -> tuple[str, str]:
    """Return the integrator that judges a run of this one, and how to say that."""
    # "mjINT_IMPLICITFAST" is "implicitfast" in a config.
    own = mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower()
    other = _OTHER_INTEGRATOR.get(own, "euler")
    return other, f"with integrator {other} instead of {own}"


def half_time_step(timestep: float) -> str:
    """Say that a run with this time step is judged with half of it."""
    return f"with a time step of {0.5 * timestep:g} s instead of {timestep:g} s"


def same_time_step(timestep: float) -> str:
    """Say why a run is judged with its own time step."""
    return f"with its time step of {timestep:g} s, in which its actuators count their lags"


def _changes(
    task: ManagerBasedRlEnvCfg, given: Collection[str]
) -> tuple[dict[str, Any], list[str]]:
    """Return the fields of `SimCfg` to change, and how to say that."""
    # The model's own options count where the config leaves them open.
    spec = scene_spec(task.scene, task.sim)
    changes: dict[str, Any] = {}
    words: list[str] = []
    if f"{PREFIX}integrator" not in given:
        changes["integrator"], said = other_integrator(spec.option)
        words.append(said)
    timestep = float(spec.option.timestep)
    if f"{PREFIX}timestep" in given:
        return changes, words
    # Lags in substeps would be half as long in seconds with half the time step.
    if counts_substeps(task):
        words.append(same_time_step(timestep))
        return changes, words
    changes["timestep"] = 0.5 * timestep
    words.append(half_time_step(timestep))
    return changes, words


def counts_substeps(task: ManagerBasedRlEnvCfg) -> bool:
    """Whether an actuator would mean another time by as many substeps."""
    for robot in task.scene.entities.values():
        for actuator in getattr(robot, "actuators", ()):
            if actuator.counts_substeps:
                return True
    return False
