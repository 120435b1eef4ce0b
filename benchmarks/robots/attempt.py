"""Tries one file: the analysis, the task, and some iterations of training on MuJoCo's C engine."""

import dataclasses
import tempfile
import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ksim_rl import conf
from ksim_rl.envs.robots import analyse
from ksim_rl.scene.robots.analysis import TRIAL_S
from ksim_rl.tasks.velocity import VelocityTask
from ksim_rl.trainers import RunCfg, RunProgress, run

ITERATIONS, NUM_ENVS = 3, 8
SETTINGS = (
    f"num_envs={NUM_ENVS}",
    "data.num_env_states_per_minibatch=96",
    "modules.actor.hidden_dims=[16]",
    "modules.critic.hidden_dims=[16]",
    f"trainer.num_iterations={ITERATIONS}",
    "trainer.eval_episodes=0",
    "trainer.video=false",
    "logger=none",
)


@dataclass(frozen=True, kw_only=True)
class Listed:
    """A file of the list: the feet of a robot that walks, or words of the line that another file is to get."""

    path: str
    feet: Sequence[str] = ()
    refusal: str = ""


@dataclass(kw_only=True)
class Attempt:
    """What came of a file: "stands", "falls", "refused" or "traceback", in how many seconds, and what was said."""

    outcome: str
    seconds: float = 0.0
    stands_s: float = 0.0
    pose: str = ""
    feet: Sequence[str] = ()
    trained: int = 0
    said: str = ""
    as_listed: bool = False
    commit: str = ""


def attempt(listed: Listed, folder: Path) -> Attempt:
    """Try a file of a folder of packages; no error of it ends the benchmark."""
    began = time.monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what files name twice; the tests are of what is said
        try:
            found = _tried(listed, folder / listed.path)
        except ValueError as error:
            text = str(error).replace(f"{folder}/", "")
            found = Attempt(outcome="refused" if "\n" not in text else "traceback", said=text)
            found.as_listed = bool(listed.refusal) and listed.refusal in text
        except Exception as error:
            found = Attempt(
                outcome="traceback", said="".join(traceback.format_exception(error))[-1000:]
            )
    found.seconds = round(time.monotonic() - began, 1)
    return found


def _tried(listed: Listed, path: Path) -> Attempt:
    analysis = analyse(path)
    stands = analysis.stands_s >= TRIAL_S
    found = Attempt(
        outcome="stands" if stands else "falls",
        stands_s=analysis.stands_s,
        pose=analysis.pose,
        feet=analysis.foot_bodies,
    )
    found.as_listed = stands and set(analysis.foot_bodies) == set(listed.feet)
    if stands:
        task = VelocityTask.for_robot(analysis, name="of_a_stranger")
        found.trained = _train(task)
    return found


def _train(task: VelocityTask) -> int:
    """Train a task for some iterations on MuJoCo's C engine, for which nothing is compiled; return their number."""
    cfg = conf.compose(["task=go1_velocity_flat", *SETTINGS])
    env_cfg = task.cfg()
    scene = dataclasses.replace(env_cfg.scene, num_envs=NUM_ENVS)
    sim = dataclasses.replace(env_cfg.sim, engine="c")
    env_cfg = dataclasses.replace(env_cfg, scene=scene, sim=sim)
    cfg: RunCfg = dataclasses.replace(cfg, task=env_cfg, task_name=task.name)
    with tempfile.TemporaryDirectory() as folder:
        outcome = run(cfg, Path(folder) / "run", progress=RunProgress(ITERATIONS, enabled=False))
    return outcome.iteration
