"""Compares observations, rewards, terminations and actions with mjlab's own, in the states of a run of mjlab's.

    python -m benchmarks.peer_terms --python PEER/bin/python [--envs 10] [--steps 100]

mjlab runs in an environment of its own, whose interpreter `--python` names (`benchmarks.peers` says why), with random
actions, on the CPU. Each of its physics steps is repeated here from its own state; so contacts, and the clocks of feet
that follow from them, are computed here. A difference is the largest one over all states (envs times steps), divided by
the largest number that mjlab has for that term.
"""

import argparse
import dataclasses
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks import command_line, report
from benchmarks.peers import TASKS, has_mjlab
from ksim_rl import envs
from ksim_rl.envs import ManagerBasedRlEnv, RewardTerm
from ksim_rl.scene.names import scalar_joint_ids

PROGRAM = Path(__file__).with_name("peer_run.py")
MOST = 1e-3
"""A relative difference that rounding and two solvers' tolerances explain."""
CLOCKS = {
    "current_air_time": "air_time_EN",
    "last_air_time": "last_air_time_EN",
    "current_contact_time": "contact_time_EN",
    "last_contact_time": "last_contact_time_EN",
}
OURS = {"actor/joint_pos": "joint_pos_biased"}
"""Our names of observations that have another one: groups share terms by name."""

KINDS = {
    "reward": "reward/",
    "observation": "obs/",
    "termination": "end/",
    "clock": "clock/",
    "action": "action/",
}
NOT_COMPARED = ("moment/foot_height", "reward/self_collisions", "obs/foot_contact_forces")
"""Forces are counted instead: `states_with_other_forces`."""
OF_JOINTS = ("pose", "dof_pos_limits")
"""Rewards that read joint positions alone."""

ON_PURPOSE = {
    "moment": "mjlab's rewards read poses and velocities one physics step late, ours of the state reached",
    "foot heights": "mjlab casts them one env step before rewards read them; below the plane its rays miss, and give 0",
    "contacts observed": "mjlab reads them after one more forward pass in steps in which any env resets, else as we do",
    "foot_swing_height": "mjlab's peaks of feet outlive resets; compared until an env's first reset",
    "self_collisions": "mjlab reads whichever contact comes first, ours the strongest one",
    "forces": "in some states, mostly falls, two versions of MuJoCo find other contact forces",
}
"""What is not compared, or only at one moment, and why."""

Record = Mapping[str, np.ndarray]


def recorded(python: str, task: str, *, num_envs: int, steps: int) -> Record:
    """Let mjlab run its task, and return what it had in each state."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "run.npz"
        # Not by its path: the modules beside it would stand in front of the standard library's.
        words = [
            python,
            "-c",
            PROGRAM.read_text(),
            TASKS[task],
            str(num_envs),
            str(steps),
            str(output),
        ]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        with np.load(output) as file:
            return dict(file)


class Replay:
    """Our env in the states of a run of mjlab's; `values` are ours by term, [T, E, ...]."""

    def __init__(self, task: str, record: Record) -> None:
        cfg = envs.task(task).cfg()
        scene = dataclasses.replace(cfg.scene, num_envs=len(record["encoder_bias"]))
        # As many iterations as there: a few would leave other contact forces than its solver leaves.
        sim = dataclasses.replace(cfg.sim, iterations=100, ls_iterations=50)
        self._env = ManagerBasedRlEnv(dataclasses.replace(cfg, scene=scene, sim=sim, seed=0))
        self._record = record
        self._everybody_E = torch.ones(self._env.num_envs, dtype=torch.bool)
        self._env.reset()
        self._take_model()
        self.values: dict[str, list[np.ndarray]] = {}
        for step in range(len(record["action"])):
            self._step(step)
        self._env.close()

    def _take_model(self) -> None:
        """Give our worlds the numbers that mjlab drew at start-up."""
        env, record, model = self._env, self._record, self._env.world.mj_model
        kinds = {"geom_friction": "geom", "body_ipos": "body"}
        for field, kind in kinds.items():
            names = list(record[f"names/{kind}"])
            own = env.view.resolver.names(kind)
            shared = [name for name in own if name in names]
            values = torch.from_numpy(record[f"field/{field}"])[
                :, [names.index(name) for name in shared]
            ]
            env.world.field(field)[:, [own.index(name) for name in shared]] = values
        env.world.set_const(["body_ipos", "geom_friction"])
        joints = [model.joint(int(i)).name for i in scalar_joint_ids(model)]
        theirs = list(record["names/joint"])
        # mjlab's floating base comes first in both.
        if theirs[1:] != joints:
            raise ValueError(f"joints are {theirs[1:]} there and {joints} here")
        env.view.encoder_bias_EL.copy_(torch.from_numpy(record["encoder_bias"]))
        drives = [model.joint(int(i)).name for i in model.actuator_trnid[:, 0]]
        # Their column of each of our actuators.
        self.ctrl = [list(record["names/actuator"]).index(name) for name in drives]

    def _keep(self, name: str, value: Tensor) -> None:
        self.values.setdefault(name, []).append(value.detach().float().numpy().copy())

    def _put(self, state: str, step: int) -> None:
        world = self._env.world
        world.qpos_EL.copy_(torch.from_numpy(self._record[f"{state}/qpos"][step]))
        world.qvel_EL.copy_(torch.from_numpy(self._record[f"{state}/qvel"][step]))

    def _refresh(self) -> None:
        self._env.world.refresh()
        self._env.driver.refreshed()

    def _command(self, value_E3: np.ndarray) -> None:
        self._env.driver.readings.commands["twist"].copy_(torch.from_numpy(value_E3))
        self._env.view.command_cache.clear()

    def _step(self, step: int) -> None:
        env, driver, world, record = self._env, self._env.driver, self._env.world, self._record
        driver.step_count.add_(1)
        env.action_manager.apply(torch.from_numpy(record["action"][step]))
        self._keep("action/controls", world.ctrl_EL)
        decimation = env.cfg.decimation
        for substep in range(step * decimation, (step + 1) * decimation):
            self._put("substep", substep)
            world.ctrl_EL.copy_(torch.from_numpy(record["substep/ctrl"][substep][:, self.ctrl]))
            warm = torch.from_numpy(record["substep/qacc_warmstart"][substep])
            world.view("qacc_warmstart").copy_(warm)
            world.step(1, before=driver.before_substep, after=driver.after_substep, sensors="every")
        driver.keep_moment_of_contacts()
        # mjlab's rewards read the state at the start of the last physics step.
        self._put("substep", (step + 1) * decimation - 1)
        self._refresh()
        driver.episode_step_E.add_(1)
        driver.update_sensors()
        self._command(record["command"][step])
        self._judge()
        self._rate({name: term for name, term in env.cfg.rewards.items() if name not in OF_JOINTS})
        # Joint positions of mjlab's are of the state that the step has reached.
        self._put("rated", step)
        self._refresh()
        self._rate({name: env.cfg.rewards[name] for name in OF_JOINTS})
        reset_E = torch.from_numpy(record["reset"][step])
        driver.buffers.clear(reset_E)
        driver.episode_step_E.masked_fill_(reset_E, 0)
        self._put("reached", step)
        self._refresh()
        self._observe(step)

    def _rate(self, rewards: Mapping[str, RewardTerm]) -> None:
        for name, term in rewards.items():
            with self._env.driver.scope(f"rewards/{name}"):
                self._keep(f"reward/{name}", term(self._env.view))

    def _judge(self) -> None:
        """Keep the terminations, and what contacts are at the moment of the rewards."""
        env = self._env
        for name, term in env.cfg.terminations.items():
            with env.driver.scope(f"terminations/{name}"):
                self._keep(f"end/{name}", term(env.view))
        contact = env.view.contact("feet_ground_contact")
        for theirs, own in CLOCKS.items():
            self._keep(f"clock/{theirs}", getattr(contact, own))
        readings = env.observation_manager.read()
        self._keep("moment/foot_height", readings["foot_height"])
        for name in ("foot_contact", "foot_contact_forces"):
            self._keep(f"obs/{name}", readings[name])

    def _observe(self, step: int) -> None:
        env, record = self._env, self._record
        term = env.cfg.commands["twist"]
        with env.driver.scope("commands/twist"):
            target_E4 = np.concatenate(
                (record["drawn/velocity"][step], record["drawn/heading"][step][:, None]), 1
            )
            env.view.buffer("target_E4", 4).copy_(torch.from_numpy(target_E4))
            kinds_E2 = np.stack((record["drawn/standing"][step], record["drawn/heads"][step]), 1)
            env.view.buffer("kind_E2", 2, dtype=torch.bool).copy_(torch.from_numpy(kinds_E2))
            self._command(term(env.view).numpy())
        readings = env.observation_manager.read()
        for name in record:
            if name.startswith(("obs/actor/", "obs/critic/")):
                group_and_term = name.removeprefix("obs/")
                own = OURS.get(group_and_term, group_and_term.rpartition("/")[2])
                self._keep(name, readings[own])


def differences(
    record: Record, values: Mapping[str, list[np.ndarray]], ctrl: Sequence[int]
) -> Iterator[tuple[str, float]]:
    """Yield the largest relative difference of each term, over states where both mean the same (`ON_PURPOSE`)."""
    decimation = len(record["substep/ctrl"]) // len(record["action"])
    ours_by_name = {name: np.stack(kept) for name, kept in values.items()}
    means_same = same_states(record, ours_by_name)
    for name, ours in ours_by_name.items():
        if name in NOT_COMPARED:
            continue
        if name == "action/controls":
            theirs = record["substep/ctrl"][::decimation][..., list(ctrl)]
        else:
            theirs = record[name].astype(np.float32)
        largest = float(np.abs(theirs).max())
        differs = np.abs(ours - theirs)
        if name in means_same:
            differs = differs[means_same[name]]
        yield name, float(differs.max()) / (largest or 1.0)


def same_states(record: Record, ours: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the states [T, E] in which some terms mean the same, bool; the reasons are in `ON_PURPOSE`."""
    return {
        "reward/foot_swing_height": np.asarray(np.cumsum(record["reset"], 0) == record["reset"]),
        "reward/foot_clearance": np.asarray((ours["moment/foot_height"] >= 0.0).all(-1)),
        "obs/critic/foot_height": np.asarray((ours["obs/critic/foot_height"] >= 0.0).all(-1)),
        "reward/soft_landing": equal_forces(record, ours),
    }


def equal_forces(record: Record, ours: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return where both physics find the same contact forces, to `MOST` of the largest, bool [T, E]."""
    theirs = newtons(record["obs/foot_contact_forces"])
    differs = np.abs(newtons(ours["obs/foot_contact_forces"]) - theirs).max(-1)
    return np.asarray(differs <= MOST * np.abs(theirs).max())


def newtons(scaled: np.ndarray) -> np.ndarray:
    """Undo sign(f) log(1 + |f|), which shows 0.01 N beside no force as much as 5 N beside 500."""
    return np.sign(scaled) * np.expm1(np.abs(scaled))


def main() -> None:
    """Compare both tasks, print the terms, and write the largest differences."""
    parser = argparse.ArgumentParser(description="Terms beside mjlab's, in its own states.")
    parser.add_argument("--python", help="the interpreter of an environment with mjlab and rsl_rl")
    parser.add_argument("--envs", type=int, default=10)
    parser.add_argument("--steps", type=int, default=100)
    options = parser.parse_args()
    if options.python is None or not has_mjlab(options.python):
        print("no peer: give --python the interpreter of an environment with mjlab and rsl_rl")
        return
    figures: dict[str, float] = {}
    for task in ("go1_velocity_flat", "g1_velocity_flat"):
        robot = task.partition("_")[0]
        record = recorded(options.python, task, num_envs=options.envs, steps=options.steps)
        replay = Replay(task, record)
        found = dict(differences(record, replay.values, replay.ctrl))
        for name, difference in found.items():
            print(f"{robot} {name:<40} {difference:.2g}{'' if difference <= MOST else '  (!)'}")
        for kind, prefix in KINDS.items():
            largest = max(value for name, value in found.items() if name.startswith(prefix))
            figures[f"{robot}/largest_{kind}_difference"] = float(f"{largest:.2g}")
        figures[f"{robot}/states"] = options.envs * options.steps
        ours = {name: np.stack(kept) for name, kept in replay.values.items()}
        figures[f"{robot}/states_with_other_forces"] = int((~equal_forces(record, ours)).sum())
    path = report.write(
        "peer_terms", figures=figures, device=torch.device("cpu"), module="benchmarks.peer_terms"
    )
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
