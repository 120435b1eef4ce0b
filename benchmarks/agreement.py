"""Agreement of the batched physics (float32, Warp) with MuJoCo's C engine (float64), per model and quantity.

    python -m benchmarks.agreement [--device cpu] [--worlds 64] [--models quadruped go1_velocity_flat robot.xml ...]
    python -m benchmarks.agreement --generated 400 [--seed 0] [--jobs 2] [--minutes 15] [--shrink]
    python -m benchmarks.agreement --registered [--jobs 2] [--minutes 15]

Models are small ones, robots of the menagerie (where MENAGERIE_ROOT is set), the flat tasks, or any MJCF file. Both
engines start from the same float32 states without a warm start, run the same substeps, and are compared after the last
one. The error of a world is its largest deviation, relative to the scale of the quantity: the median over worlds of the
C engine's largest absolute value. Each sensor is a quantity of its own, and `sensordata` shows the worst of them in
each column. `contact_force` counts only worlds with a contact.

Each model runs twice: with its own solver tolerance, and as worlds train: with MuJoCo Warp's 1e-6, and for tasks with
the settings of the task. The C engine iterates until its own tolerance in both.

`--generated` draws random models instead (`benchmarks/judge`), and compares all that a view can name. Those that fail
are written to build/judge, with `--shrink` made small. `--registered` judges the models of all registered tasks and all
robot files in the same way; what comes from a package that is not installed is left out, and named.
"""

import argparse
import copy
import dataclasses
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import torch

from benchmarks import command_line, report
from benchmarks.agreement_errors import COMPARED, CONTACT_LIMIT, FAR_LIMIT, Errors, compare
from benchmarks.agreement_models import CARTPOLE, DOUBLE_PENDULUM, QUADRUPED, SPINNING_BODY
from benchmarks.agreement_states import States, anywhere, in_contact, thrown
from benchmarks.judge import hunt, registered
from ksim_rl import envs
from ksim_rl.checks import unknown_name
from ksim_rl.device.streams import checked_device
from ksim_rl.envs.contract import SimulatedWorld, part
from ksim_rl.physics import SimCfg, World, load_model, load_spec
from ksim_rl.physics.model_files.source import SUFFIXES

FAILURES = Path("build/judge")
SMOOTH_LIMIT = 1e-4
CONTACT_SHARE, MEDIAN_LIMIT, FAR_SHARE = 0.95, 1e-5, 0.99


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One model: how to get it, how long to run, and how its states are drawn.

    `start` is "anywhere" for what touches nothing, "standing" for robots with a keyframe, whose controls jump by about
    `spread`, or "thrown" for anything.
    """

    name: str
    load: Callable[[], mujoco.MjModel]
    substeps: int = 20
    start: Literal["anywhere", "standing", "thrown"] = "thrown"
    spread: float = 0.2

    def states(self, mj_model: mujoco.MjModel, num_worlds: int, seed: int = 0) -> States:
        """Draw the states to start from."""
        if self.start == "anywhere":
            return anywhere(mj_model, num_worlds, seed=seed)
        if self.start == "thrown":
            return thrown(mj_model, num_worlds, seed=seed)
        return in_contact(mj_model, num_worlds, spread=self.spread, seed=seed)


def with_contact_sensors(name: str, bodies: tuple[str, ...]) -> mujoco.MjModel:
    """Load a menagerie robot with a net contact force sensor on each of `bodies`."""
    spec = load_spec(name)
    found, force, net_force = 1 << 0, 1 << 1, 3
    for body in bodies:
        spec.add_sensor(
            name=f"{body}_contact",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=body,
            intprm=[found | force, net_force, 1],
        )
    return load_model(spec)


def of_task(name: str) -> mujoco.MjModel:
    """Return the model of a task, as its worlds have it."""
    env = envs.make(name, num_envs=1, seed=0)
    simulated = part(env, SimulatedWorld)
    assert simulated is not None
    mj_model = copy.copy(simulated.world.mj_model)
    env.close()
    return mj_model


# One for each robot of the tasks.
TASKS = (
    "arm_push cartpole_swingup cheetah_run g1_velocity_flat go1_velocity_flat go2_velocity_flat hopper_hop "
    "humanoid_get_up humanoid_velocity_flat pendulum_swingup quadruped_get_up quadruped_velocity_flat reacher "
    "t1_velocity_flat walker_walk"
)
CASES = (
    Case(name="cartpole", load=lambda: load_model(CARTPOLE), substeps=100, start="anywhere"),
    Case(
        name="double_pendulum",
        load=lambda: load_model(DOUBLE_PENDULUM),
        substeps=100,
        start="anywhere",
    ),
    Case(
        name="spinning_body", load=lambda: load_model(SPINNING_BODY), substeps=100, start="anywhere"
    ),
    Case(name="quadruped", load=lambda: load_model(QUADRUPED), start="standing", spread=0.3),
    Case(
        name="unitree_go1",
        load=lambda: with_contact_sensors(
            "unitree_go1", ("FR_calf", "FL_calf", "RR_calf", "RL_calf")
        ),
        start="standing",
    ),
    Case(
        name="unitree_g1",
        load=lambda: with_contact_sensors(
            "unitree_g1", ("left_ankle_roll_link", "right_ankle_roll_link")
        ),
        start="standing",
        spread=0.05,
    ),
    *(
        Case(name=name, load=partial(load_model, name))
        for name in ("unitree_go2", "booster_t1", "unitree_a1", "robotis_op3")
    ),
    *(Case(name=name, load=partial(of_task, name)) for name in TASKS.split()),
)


def run_c_engine(mj_model: mujoco.MjModel, states: States, substeps: int) -> dict[str, np.ndarray]:
    """Return the quantities [E, ...] after `substeps` of mj_step, in float64, and the number of contacts [E]."""
    mj_model = copy.copy(mj_model)
    mj_model.opt.iterations, mj_model.opt.ls_iterations = 100, 50
    mj_data = mujoco.MjData(mj_model)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in (*COMPARED, "ncon")}
    for row in range(len(states.qpos_EL)):
        states.put(mj_data, row)
        for _ in range(substeps):
            mujoco.mj_step(mj_model, mj_data)
        for name, values in rows.items():
            values.append(np.array(getattr(mj_data, name), dtype=np.float64).reshape(-1))
    return {name: np.stack(values) for name, values in rows.items()}


def run_warp(
    mj_model: mujoco.MjModel, states: States, substeps: int, *, device: torch.device, sim: SimCfg
) -> dict[str, np.ndarray]:
    """Return the same quantities from a world on `device`.

    Raises:
        RuntimeError: if contacts or constraints did not fit, since the comparison would be of something else.
    """
    world = World(mj_model, num_envs=len(states.qpos_EL), device=device, sim=sim)
    for view, values in (
        (world.qpos_EL, states.qpos_EL),
        (world.qvel_EL, states.qvel_EL),
        (world.ctrl_EL, states.ctrl_EL),
    ):
        view.copy_(torch.from_numpy(values))
    world.step(substeps, sensors="every")
    overflow = world.overflow_report()
    if not overflow.ok:
        raise RuntimeError("; ".join(overflow.messages))
    found = {
        name: world.view(name).cpu().numpy().astype(np.float64).reshape(world.num_envs, -1)
        for name in COMPARED
    }
    owners = (
        world.last_substep("contact.worldid")[: int(world.last_substep("nacon").item())]
        .cpu()
        .numpy()
    )
    found["ncon"] = np.bincount(owners, minlength=world.num_envs)[:, None].astype(np.float64)
    world.close()
    return found


@dataclasses.dataclass(frozen=True, kw_only=True)
class Agreement:
    """What was measured of one model.

    Args:
        errors: per quantity, at the model's own solver tolerance.
        errors_as_trained: the same with the settings that worlds train with.
        other_contacts_share: worlds in which the engines found different numbers of contacts.
    """

    errors: dict[str, Errors]
    errors_as_trained: dict[str, Errors]
    other_contacts_share: float


def measure(case: Case, *, num_worlds: int, device: torch.device) -> Agreement:
    """Run both engines from the same states."""
    mj_model = case.load()
    states = case.states(mj_model, num_worlds)
    expected = run_c_engine(mj_model, states, case.substeps)
    own = SimCfg(tolerance=float(mj_model.opt.tolerance))
    actual, as_trained = (
        run_warp(mj_model, states, case.substeps, device=device, sim=sim) for sim in (own, SimCfg())
    )
    return Agreement(
        errors=compare(mj_model, actual, expected),
        errors_as_trained=compare(mj_model, as_trained, expected),
        other_contacts_share=float(np.mean(actual["ncon"] != expected["ncon"])),
    )


def agrees(case: Case, found: Errors) -> bool:
    """Whether the errors of a quantity are within the limits of its kind of model."""
    if case.start == "anywhere":
        return found.max <= SMOOTH_LIMIT
    near, far = found.share_within_1e_3 >= CONTACT_SHARE, found.share_within_1e_2 >= FAR_SHARE
    return near and far and found.median <= MEDIAN_LIMIT


def chosen_cases(names: list[str] | None) -> list[Case]:
    """Return the cases of these names, tasks and files, or all of ours; menagerie robots only with a MENAGERIE_ROOT.

    Raises ValueError where a name is unknown, or one of them is named and there is no such folder.
    """
    cases = {case.name: case for case in CASES}
    if names is None:
        offline = "MENAGERIE_ROOT" not in os.environ
        return [case for case in CASES if not (offline and _needs_menagerie(case.name))]
    chosen = []
    for name in names:
        path = Path(name)
        if path.suffix in SUFFIXES:
            called = path.parent.resolve().name if path.stem == "scene" else path.stem
            chosen.append(Case(name=called, load=partial(load_model, path)))
        elif name not in cases and name not in envs.names():
            raise unknown_name("--models", name, [*cases, *envs.names()])
        elif _needs_menagerie(name) and "MENAGERIE_ROOT" not in os.environ:
            raise ValueError(f"--models {name}: set MENAGERIE_ROOT to the folder of this robot")
        else:
            chosen.append(cases.get(name) or Case(name=name, load=partial(of_task, name)))
    return chosen


def _needs_menagerie(name: str) -> bool:
    return name.startswith(("unitree", "booster", "robotis", "go1", "go2", "g1", "t1"))


def hunt_generated(options: argparse.Namespace, device: torch.device) -> int:
    """Judge random models, write what was found, and return 1 if any differs from C."""
    outcomes = hunt.hunt(
        options.generated,
        seed=options.seed,
        device=options.device,
        jobs=options.jobs,
        shrinks=options.shrink,
        most_minutes=options.minutes,
    )
    prefix = f"{report.device_label(device)}/generated"
    figures = {f"{prefix}/{name}": value for name, value in hunt.figures(outcomes).items()}
    for name, value in figures.items():
        print(f"{name:40s}{value:g}")
    hunt.keep_failures(outcomes, FAILURES)
    path = report.write(
        "agreement",
        figures=figures,
        device=device,
        module="benchmarks.agreement",
        generated_refused={prefix: hunt.refusals(outcomes)},
        generated_features={prefix: hunt.features_of(outcomes)},
    )
    print(f"written: {path}")
    return 1 if figures[f"{prefix}/worse"] else 0


def judge_registered(options: argparse.Namespace, device: torch.device) -> int:
    """Judge the models of registered tasks and robot files, write what was found, and return 1 if any differs."""
    names, not_here = registered.tasks_of_models(envs.names())
    if not_here:
        print(f"not installed: {', '.join(not_here)}", flush=True)
    tasks = [
        registered.Registered(name=name, is_task=True, device=options.device) for name in names
    ]
    for path in registered.robot_files():
        tasks.append(registered.Registered(name=path, is_task=False, device=options.device))
    outcomes = registered.judge_all(tasks, jobs=options.jobs, most_minutes=options.minutes)
    prefix = f"{report.device_label(device)}/registered"
    figures = {f"{prefix}/{name}": value for name, value in registered.figures(outcomes).items()}
    figures[f"{prefix}/not_judged"] = len(not_here) + len(tasks) - len(outcomes)
    for name, value in figures.items():
        print(f"{name:40s}{value:g}")
    path = report.write("agreement", figures=figures, device=device, module="benchmarks.agreement")
    print(f"written: {path}")
    return 1 if figures[f"{prefix}/worse"] else 0


def main(arguments: list[str] | None = None) -> int:
    """Print the table, write the results, and return 1 if anything disagrees."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.agreement", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument(
        "--models", nargs="+", metavar="MODEL", help="names of models or tasks, or MJCF files"
    )
    parser.add_argument(
        "--generated", type=int, default=0, metavar="N", help="judge N random models instead"
    )
    parser.add_argument(
        "--registered", action="store_true", help="judge all registered tasks and robot files"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random models")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, help="processes for random models"
    )
    parser.add_argument(
        "--minutes", type=float, default=math.inf, help="begin no further model after these"
    )
    parser.add_argument(
        "--shrink", action="store_true", help="make each random model that fails small"
    )
    options = parser.parse_args(arguments)
    device = checked_device(options.device)
    if options.generated:
        return hunt_generated(options, device)
    if options.registered:
        return judge_registered(options, device)
    cases = chosen_cases(options.models)
    label = report.device_label(device)
    figures, all_agree = {}, True
    header = (
        f"{'model':24s}{'quantity':16s}{'scale':>9s}{'median':>9s}{'95 %':>9s}{'max':>9s}{'<= 1e-3':>9s}"
        f"  as trained:{'median':>9s}{'<= 1e-3':>9s}{'<= 1e-2':>9s}"
    )
    print(header, "-" * len(header), sep="\n")
    for case in cases:
        found = measure(case, num_worlds=options.worlds, device=device)
        for quantity, values in found.errors.items():
            as_trained = found.errors_as_trained[quantity]
            # Velocities and forces of what has come to rest have no scale, and forces follow the tolerance.
            good = case.start == "thrown" or agrees(case, values)
            if quantity == "qpos":
                good = agrees(case, values) and agrees(case, as_trained)
            all_agree &= good
            print(
                f"{case.name:24s}{quantity:16s}{values.scale:9.3g}{values.median:9.1e}{values.p95:9.1e}"
                f"{values.max:9.1e}{values.share_within_1e_3:9.1%}{as_trained.median:21.1e}"
                f"{as_trained.share_within_1e_3:9.1%}{as_trained.share_within_1e_2:9.1%}"
                f"{'' if good else '  DISAGREES'}"
            )
            prefix = f"{label}/{case.name}/{quantity}"
            figures |= {
                f"{prefix}/{key}": value for key, value in dataclasses.asdict(values).items()
            }
            figures |= {
                f"{prefix}/as_trained/{key}": value
                for key, value in dataclasses.asdict(as_trained).items()
            }
        figures[f"{label}/{case.name}/other_contacts_share"] = found.other_contacts_share
        if case.start != "anywhere":
            share = found.other_contacts_share
            print(
                f"{case.name:24s}the engines differ in their number of contacts in {share:.1%} of worlds"
            )
    limits = {
        "smooth models, 100 substeps, all worlds": SMOOTH_LIMIT,
        "robots in contact, 20 substeps, 95 % of worlds": CONTACT_LIMIT,
        "robots in contact, 20 substeps, 99 % of worlds": FAR_LIMIT,
        "robots in contact, 20 substeps, median": MEDIAN_LIMIT,
    }
    path = report.write(
        "agreement", figures=figures, device=device, module="benchmarks.agreement", limits=limits
    )
    print(f"written: {path}")
    return 0 if all_agree else 1


if __name__ == "__main__":
    command_line.run(main)
