"""Judges the models of registered tasks and of robot files, in child processes."""

import copy
import dataclasses
import hashlib
import os
import time
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from benchmarks.judge.hunt import MOST_SECONDS, compile_quickly, has_error, told_of
from benchmarks.judge.trial import NUM_WORLDS, SETTINGS, Given, Verdict, judge, judge_worlds, reason
from benchmarks.judge.workers import in_processes
from benchmarks.judge.worlds import solved_well, state_of_row
from ksim_rl import envs, scene
from ksim_rl.envs.contract import SimulatedWorld, part
from ksim_rl.physics import World
from ksim_rl.physics.fields import ALL, GRAVITY, derived_fields, write_fields
from ksim_rl.physics.warp_world import WarpWorld

# Steps of random actions, after which states are taken.
STEPS = 12
SEED = 0
# What is said where a package of models, or a robot of the menagerie, is not here.
_NOT_INSTALLED = ("pip install", "is not here", "MENAGERIE_ROOT", "could not be downloaded")
OWN_ROBOTS = Path(scene.__file__).parent / "robots"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Registered:
    """What is judged of one task or file.

    Args:
        name: of the task, or the file.
        is_task: whether it is a task.
        device: where its worlds are.
    """

    name: str
    is_task: bool
    device: str = "cpu"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RegisteredOutcome:
    """What became of it.

    Attributes:
        verdict: what was found.
        error: what was raised, which nothing should.
    """

    verdict: Verdict = Verdict()
    error: str = ""

    @property
    def fails(self) -> bool:
        """Whether something differs from C, or was raised."""
        return bool(self.error or self.verdict.findings)


def tasks_of_models(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return one task for each model among the tasks `names`, and what is not installed."""
    found: dict[str, str] = {}
    not_here = []
    for name in names:
        try:
            env = _env_of(name)
        except ValueError as error:
            if not any(word in str(error) for word in _NOT_INSTALLED):
                raise
            not_here.append(name)
            continue
        except RuntimeError:
            # It is reported when the task is judged.
            found[name] = name
            continue
        found.setdefault(_digest(_world_of(env).mj_model), name)
        env.close()
    return list(found.values()), not_here


def robot_files() -> list[str]:
    """Return the robot files of the package, and of the menagerie where MENAGERIE_ROOT is set."""
    files = sorted(OWN_ROBOTS.glob("*.xml"))
    root = os.environ.get("MENAGERIE_ROOT")
    if root:
        files += sorted(Path(root).glob("*/*.xml"))
    return [str(path) for path in files]


def judged(task: Registered) -> RegisteredOutcome:
    """Judge a task's model or a robot file."""
    compile_quickly(task.device)
    try:
        verdict = _judged_task(task) if task.is_task else _judged_file(task)
    except Exception:
        return RegisteredOutcome(error=traceback.format_exc(limit=-6))
    return RegisteredOutcome(verdict=verdict)


def _judged_file(task: Registered) -> Verdict:
    return judge(task.name, forces=False, seed=SEED, device=task.device)


def _judged_task(task: Registered) -> Verdict:
    """Judge a task's worlds with the fields that its events gave them, in states that random actions lead to."""
    env = _env_of(task.name)
    own = _world_of(env)
    tensordict = env.reset()
    for _ in range(STEPS):
        tensordict = step_mdp(env.rand_step(tensordict))
    values = {}
    for name, field in own.per_world_fields().items():
        values[name] = field.numpy(force=True).astype(np.float64)
    states = [state_of_row(own, row) for row in range(NUM_WORLDS)]
    mj_model = own.mj_model
    env.close()
    derived = (GRAVITY, *derived_fields(ALL))
    fields = tuple(name for name in values if name not in derived)
    try:
        world = WarpWorld(
            mj_model,
            num_envs=NUM_WORLDS,
            device=task.device,
            sim=SETTINGS["ours"],
            per_world_fields=fields,
        )
    except ValueError as error:
        return Verdict(refused=reason(str(error)))
    for name, value in values.items():
        field = world.field(name)
        field.copy_(torch.from_numpy(value).reshape(field.shape))
    models = []
    for row in range(NUM_WORLDS):
        of_row = copy.copy(world.mj_model)
        write_fields(of_row, {name: value[row] for name, value in values.items()})
        models.append(solved_well(of_row))
    return judge_worlds(world, Given(fields=fields, models=models, states=states), seed=SEED)


def _env_of(name: str) -> EnvBase:
    """Return an env of a task on the C engine, for which nothing is compiled; on Warp where cameras draw its worlds."""
    where = {"num_envs": NUM_WORLDS, "seed": SEED, "device": "cpu"}
    try:
        return envs.make(name, overrides=["task.sim.engine=c"], **where)
    except ValueError as error:
        if "draws pictures" not in str(error):
            raise
    return envs.make(name, overrides=["task.sim.engine=warp"], **where)


def _world_of(env: EnvBase) -> World:
    simulated = part(env, SimulatedWorld)
    assert simulated is not None, "registered tasks are simulated here"
    return simulated.world


def _digest(mj_model: mujoco.MjModel) -> str:
    """Return what is the same for two models alone that are the same in every byte."""
    content = np.empty(mujoco.mj_sizeModel(mj_model), dtype=np.uint8)
    mujoco.mj_saveModel(mj_model, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()


def judge_all(
    tasks: Sequence[Registered], *, jobs: int, most_minutes: float
) -> dict[str, RegisteredOutcome]:
    """Judge tasks and robots, as many of them as begin in time, and print each that fails."""
    until = time.monotonic() + 60.0 * most_minutes
    outcomes = {}
    for task, result in in_processes(
        judged, tasks, jobs=jobs, most_seconds=MOST_SECONDS, until=until, spoils=has_error
    ):
        outcome = result
        if isinstance(result, RuntimeError):
            outcome = RegisteredOutcome(error=str(result))
        outcomes[task.name] = outcome
        if outcome.fails:
            print(f"{task.name}, by {outcome.verdict.kernels or 'none'}")
            for line in [outcome.error, *told_of(outcome.verdict.findings)]:
                print(line, flush=True)
    return outcomes


def figures(outcomes: Mapping[str, RegisteredOutcome]) -> dict[str, float]:
    """Return the figures by name: `models` were built and stepped, and what raised is worse, too."""
    verdicts = [outcome.verdict for outcome in outcomes.values()]
    ran = [verdict for verdict in verdicts if verdict.states > 0]
    return {
        "models": len(ran),
        "states": sum(verdict.states for verdict in ran),
        "refused": sum(bool(verdict.refused) for verdict in verdicts),
        "worse": sum(outcome.fails for outcome in outcomes.values()),
        "touching": sum(verdict.touching for verdict in ran),
        "accepted_states": sum(verdict.accepted for verdict in ran),
        "unsteady_states": sum(verdict.unsteady for verdict in ran),
        "by_our_kernels": sum(verdict.kernels == "ours" for verdict in ran),
    }
