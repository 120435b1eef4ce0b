"""Agreement of the batched physics (float32, Warp) with MuJoCo's C engine (float64), per model and quantity.

    python -m benchmarks.agreement [--device cpu] [--worlds 64] [--models quadruped ...]

Both engines start from the same float32 states without a warm start, run the same substeps with the model's own
settings, and are compared after the last one. The error of a world is its largest deviation, relative to the scale
of the quantity: the median over worlds of the C engine's largest absolute value. Each sensor is a quantity of its
own, and `sensordata` shows the worst of them in each column. `contact_force` counts only worlds with a contact.

MuJoCo Warp raises a model's solver tolerance to 1e-6 by default. That is what worlds train with, and it is the last
column; all others, and the verdict, are of the tolerance that the C engine uses too. Menagerie robots take part if
MENAGERIE_ROOT is set.
"""

import argparse
import dataclasses
import os
from collections.abc import Callable

import mujoco
import numpy as np
import torch

from benchmarks import command_line, report
from benchmarks.agreement_errors import COMPARED, CONTACT_LIMIT, Errors, compare
from benchmarks.agreement_models import CARTPOLE, DOUBLE_PENDULUM, QUADRUPED, SPINNING_BODY
from benchmarks.agreement_states import States, anywhere, in_contact
from ksim_rl.device.streams import checked_device
from ksim_rl.physics import SimCfg, World, load_model, load_spec

SMOOTH_LIMIT = 1e-4
CONTACT_SHARE, MEDIAN_LIMIT = 0.95, 1e-5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One model: how to get it, how long to run, and how its states are drawn (`spread` None: it touches nothing)."""

    name: str
    load: Callable[[], mujoco.MjModel]
    substeps: int
    spread: float | None = None

    def states(self, mj_model: mujoco.MjModel, num_worlds: int, seed: int = 0) -> States:
        """Draw the states to start from."""
        if self.spread is None:
            return anywhere(mj_model, num_worlds, seed=seed)
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


CASES = (
    Case(name="cartpole", load=lambda: load_model(CARTPOLE), substeps=100),
    Case(name="double_pendulum", load=lambda: load_model(DOUBLE_PENDULUM), substeps=100),
    Case(name="spinning_body", load=lambda: load_model(SPINNING_BODY), substeps=100),
    Case(name="quadruped", load=lambda: load_model(QUADRUPED), substeps=20, spread=0.3),
    Case(
        name="unitree_go1",
        load=lambda: with_contact_sensors("unitree_go1", ("FR_calf", "FL_calf", "RR_calf", "RL_calf")),
        substeps=20,
        spread=0.2,
    ),
    Case(
        name="unitree_g1",
        load=lambda: with_contact_sensors("unitree_g1", ("left_ankle_roll_link", "right_ankle_roll_link")),
        substeps=20,
        spread=0.05,
    ),
)


def run_c_engine(mj_model: mujoco.MjModel, states: States, substeps: int) -> dict[str, np.ndarray]:
    """Return the quantities [E, ...] after `substeps` of mj_step, in float64, and the number of contacts [E]."""
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
    world.step(substeps)
    overflow = world.overflow_report()
    if not overflow.ok:
        raise RuntimeError("; ".join(overflow.messages))
    found = {
        name: world.view(name).cpu().numpy().astype(np.float64).reshape(world.num_envs, -1)
        for name in COMPARED
    }
    owners = world.view("contact.worldid")[: int(world.view("nacon").item())].cpu().numpy()
    found["ncon"] = np.bincount(owners, minlength=world.num_envs)[:, None].astype(np.float64)
    world.close()
    return found


@dataclasses.dataclass(frozen=True, kw_only=True)
class Agreement:
    """What was measured of one model.

    Args:
        errors: per quantity, at the model's own solver tolerance.
        errors_as_trained: the same at the tolerance that worlds use by default.
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
    if case.spread is None:
        return found.max <= SMOOTH_LIMIT
    return found.share_within_1e_3 >= CONTACT_SHARE and found.median <= MEDIAN_LIMIT


def chosen_cases(names: list[str] | None) -> list[Case]:
    """Return the cases to run; menagerie robots only where MENAGERIE_ROOT names their folder.

    Raises:
        ValueError: if one of them is named and there is no such folder.
    """
    offline = "MENAGERIE_ROOT" not in os.environ
    cases = [case for case in CASES if not (offline and case.name.startswith("unitree"))]
    left_out = set(names or ()) - {case.name for case in cases}
    if left_out:
        raise ValueError(
            f"--models {' '.join(sorted(left_out))}: set MENAGERIE_ROOT to the folder of these robots"
        )
    return [case for case in cases if names is None or case.name in names]


def main(arguments: list[str] | None = None) -> int:
    """Print the table, write the results, and return 1 if anything disagrees."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.agreement", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--models", nargs="+", choices=[case.name for case in CASES])
    options = parser.parse_args(arguments)
    device = checked_device(options.device)
    cases = chosen_cases(options.models)
    label = report.device_label(device)
    figures, all_agree = {}, True
    header = (
        f"{'model':16s}{'quantity':16s}{'scale':>9s}{'median':>9s}{'95 %':>9s}{'max':>9s}{'<= 1e-3':>9s}"
        f"{'median at 1e-6':>16s}"
    )
    print(header, "-" * len(header), sep="\n")
    for case in cases:
        found = measure(case, num_worlds=options.worlds, device=device)
        for quantity, values in found.errors.items():
            as_trained = found.errors_as_trained[quantity]
            all_agree &= agrees(case, values)
            print(
                f"{case.name:16s}{quantity:16s}{values.scale:9.3g}{values.median:9.1e}{values.p95:9.1e}"
                f"{values.max:9.1e}{values.share_within_1e_3:9.1%}{as_trained.median:16.1e}"
                f"{'' if agrees(case, values) else '  DISAGREES'}"
            )
            prefix = f"{label}/{case.name}/{quantity}"
            figures |= {f"{prefix}/{key}": value for key, value in dataclasses.asdict(values).items()}
            figures |= {
                f"{prefix}/as_trained/{key}": value for key, value in dataclasses.asdict(as_trained).items()
            }
        figures[f"{label}/{case.name}/other_contacts_share"] = found.other_contacts_share
        if case.spread is not None:
            share = found.other_contacts_share
            print(f"{case.name:16s}the engines differ in their number of contacts in {share:.1%} of worlds")
    limits = {
        "smooth models, 100 substeps, all worlds": SMOOTH_LIMIT,
        "robots in contact, 20 substeps, 95 % of worlds": CONTACT_LIMIT,
        "robots in contact, 20 substeps, median": MEDIAN_LIMIT,
    }
    path = report.write(
        "agreement", figures=figures, device=device, module="benchmarks.agreement", limits=limits
    )
    print(f"written: {path}")
    return 0 if all_agree else 1


if __name__ == "__main__":
    command_line.run(main)
