"""Trains policies with and without what was identified of a hidden arm, and runs both on it.

    python -m benchmarks.identified_policy
    python -m benchmarks.identified_policy --seed 3 --trainings 5

The hidden arm is the arm of `arm_reach`, worn: a seed draws its armature, damping, dry friction and the gains of its
servos. It follows the commands of `ksim-rl identify --propose arm` on MuJoCo's C engine, and its encoders are noisy and
count in steps. The task is trained as it is, and with the overrides that `ksim-rl identify` wrote, both for a minute on
a CPU and with the same seeds; all policies are then judged on the hidden arm in the C engine. Delays are not hidden
here: the arm's servos are its model's own, which no override makes late.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import mujoco
import numpy as np
import torch

from benchmarks import command_line, report
from benchmarks.identification import COUNT, NOISE, PHYSICS_S
from ksim_rl.checks import OneLineParser, check_count
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.identification.command import identify
from ksim_rl.scene.robots import Arm
from ksim_rl.trainers.run_folder import load_policy
from ksim_rl.transfer.conditions import Change, Condition
from ksim_rl.transfer.judge import judge

TASK = "arm_reach"
# From low to high, as shares of what the arm's file says, or N m.
ARMATURE = (0.6, 1.8)
DAMPING = (0.5, 1.5)
FRICTIONLOSS = (1.0, 3.0)
STIFFNESS = (0.3, 0.7)
SERVO_DAMPING = (0.3, 0.7)
# A minute on a CPU, after which the task is solved.
TRAINING = (
    f"task={TASK}",
    "num_envs=64",
    "data.num_env_states_per_minibatch=1024",
    "data.num_minibatches=4",
    "trainer.num_iterations=60",
    "trainer.eval_interval=0",
    "trainer.eval_episodes=0",
    "trainer.video=false",
    "device=cpu",
)
EPISODES = 100
EFFORT_NOISE = 0.1
"""N m, of measured efforts; the limits are 20 to 60."""


@dataclass(frozen=True, kw_only=True)
class HiddenArm:
    """The arm with numbers that come from a seed."""

    seed: int

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the arm."""
        rng = np.random.default_rng([self.seed, 56])
        spec = Arm().spec()
        for actuator in spec.actuators:
            joint = spec.joint(actuator.target)
            joint.armature = float(joint.armature) * rng.uniform(*ARMATURE)
            joint.damping = np.asarray(joint.damping) * rng.uniform(*DAMPING)
            joint.frictionloss = rng.uniform(*FRICTIONLOSS)
            stiffness = actuator.gainprm[0] * rng.uniform(*STIFFNESS)
            damping = -actuator.biasprm[2] * rng.uniform(*SERVO_DAMPING)
            actuator.gainprm = [stiffness, *[0.0] * 9]
            actuator.biasprm = [0.0, -stiffness, -damping, *[0.0] * 7]
        return spec


def main() -> int:
    """Identify a hidden arm, train with and without the result, and write what both do on it."""
    options = asked("identified_policy", __doc__)
    hidden = HiddenArm(seed=options.seed)
    with tempfile.TemporaryDirectory() as folder:
        found = identified(hidden, Path(folder))
        returns = trained(hidden, found, trainings=options.trainings, folder=Path(folder))
    figures = {f"hidden_arm/{name}": mean(values) for name, values in returns.hidden.items()}
    for name, value in figures.items():
        print(f"{name}: return {value:.2f}")
    write("identified_policy", figures, returns, seed=options.seed)
    return 0


@dataclass(frozen=True, kw_only=True)
class Returns:
    """Returns of policies trained "with" what was found and "without", by seed of the training.

    Attributes:
        hidden: on the hidden arm.
        at_home: in the env of the training.
    """

    hidden: dict[str, list[float]]
    at_home: dict[str, list[float]]


def asked(benchmark: str, text: str | None) -> Any:
    """Return the options of the command line: `seed` and `trainings`."""
    parser = OneLineParser(prog=f"python -m benchmarks.{benchmark}", description=text)
    parser.add_argument("--seed", type=int, default=7, help="of the hidden arm and the noise")
    parser.add_argument("--trainings", type=int, default=3, help="with each, of seeds 0, 1, ...")
    options = parser.parse_args()
    check_count("--trainings", options.trainings)
    return options


def trained(hidden: HiddenArm, found: Sequence[str], *, trainings: int, folder: Path) -> Returns:
    """Train with the overrides that were `found` and without, and return what the policies come to."""
    returns = Returns(hidden={"without": [], "with": []}, at_home={"without": [], "with": []})
    for seed in range(trainings):
        for name, overrides in (("without", []), ("with", found)):
            run = folder / f"{name}_{seed}"
            train(run, [*overrides, f"seed={seed}"])
            on_hidden = score(run, put_in(hidden))
            returns.hidden[name].append(on_hidden)
            returns.at_home[name].append(score(run, lambda cfg: cfg))
            print(f"{name}, seed {seed}: {on_hidden:.2f} on the hidden arm", flush=True)
    return returns


def write(benchmark: str, figures: Mapping[str, float], returns: Returns, *, seed: int) -> None:
    """Write the results of a benchmark of the hidden arm, and say where."""
    path = report.write(
        benchmark,
        figures=figures,
        device=torch.device("cpu"),
        module=f"benchmarks.{benchmark}",
        seed=seed,
        episodes=EPISODES,
        returns=returns.hidden,
        returns_in_training=returns.at_home,
    )
    print(f"written to {path}")


def identified(hidden: HiddenArm, folder: Path) -> list[str]:
    """Return the overrides that the command finds in a log of the hidden arm."""
    plan = folder / "plan.csv"
    log = folder / "log.csv"
    identify(["--propose", "arm", "--output", str(plan)])
    log.write_text(follow(hidden, plan.read_text().splitlines()))
    found = folder / "found.json"
    identify([str(log), "--robot", "arm", "--task", TASK, "--output", str(found)])
    return json.loads(found.read_text())["overrides"][TASK]


def follow(hidden: HiddenArm, plan: Sequence[str], *, has_efforts: bool = False) -> str:
    """Return the log of the hidden arm under the lines of a plan of positions, with measured efforts where asked."""
    table = np.loadtxt(plan[1:], delimiter=",")
    spec = hidden.spec()
    spec.option.timestep = PHYSICS_S
    model = spec.compile()
    data = mujoco.MjData(model)
    names = [column.partition(".")[0] for column in plan[0].split(",")[1:]]
    address = [int(model.joint(name).qposadr[0]) for name in names]
    motors = [model.actuator(name).id for name in names]
    data.qpos[address] = table[0, 1:]
    rng = np.random.default_rng([hidden.seed, 57])
    speeds = [int(model.joint(name).dofadr[0]) for name in names]
    head = [plan[0], *(f"{name}.position" for name in names)]
    if has_efforts:
        head += [f"{name}.effort" for name in names]
    lines = [",".join(head)]
    for row, (time, *asked) in enumerate(table):
        read = data.qpos[address] + rng.normal(0.0, NOISE, len(names))
        counted = np.round(read / COUNT) * COUNT
        cells = [*table[row], *counted]
        data.ctrl[motors] = asked
        if has_efforts:
            # Of the motors at the reading, before anything moves.
            mujoco.mj_forward(model, data)
            cells += list(data.qfrc_actuator[speeds] + rng.normal(0.0, EFFORT_NOISE, len(names)))
        lines.append(",".join(f"{value:.9g}" for value in cells))
        until = table[min(row + 1, len(table) - 1), 0]
        mujoco.mj_step(model, data, nstep=round((until - time) / PHYSICS_S))
    return "\n".join(lines) + "\n"


def train(run: Path, overrides: Sequence[str]) -> None:
    """Train the task in a process of its own, as a user does."""
    words = [*TRAINING, *overrides, f"hydra.run.dir={run}"]
    subprocess.run(
        [sys.executable, "-m", "ksim_rl.cli.main", "train", *words],
        check=True,
        stdout=subprocess.DEVNULL,
    )


def score(run: Path, change: Change) -> float:
    """Return the mean return of a run's policy in its task with a change."""
    policy = load_policy(run, device="cpu")
    return judge(
        policy.cfg, policy.actor, Condition(name="hidden", change=change), episodes=EPISODES
    ).return_mean


def put_in(hidden: HiddenArm) -> Change:
    """Return the change that puts the hidden arm into the task, without what its training drew."""

    def change(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        scene = dataclasses.replace(cfg.scene, robots={"arm": hidden})
        events = {
            name: event
            for name, event in (cfg.events or {}).items()
            if not name.startswith("identified_")
        }
        return dataclasses.replace(cfg, scene=scene, events=events)

    return change


if __name__ == "__main__":
    command_line.run(main)
