"""Trains policies with and without networks of motors that were fitted to a hidden arm, and runs both on it.

    python -m benchmarks.networked_policy
    python -m benchmarks.networked_policy --seed 3 --trainings 5

The hidden arm is the worn one of `benchmarks.identified_policy` whose servos are slow and weak, too: commands pass a
filter, and a seed draws its time and what is left of the effort limits, which no law of gains has. It follows the
commands of `ksim-rl identify --propose arm --targets pos`, and efforts of its motors are measured. `ksim-rl identify
--nets` fits the networks to all of the log but its last fifth, and says how far they are off there. The task is trained
as it is, and with the networks, with the same seeds; all policies are then judged on the hidden arm in the C engine.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import mujoco
import numpy as np

from benchmarks import command_line
from benchmarks.identified_policy import TASK, HiddenArm, asked, follow, trained, write
from ksim_rl import envs
from ksim_rl.identification.actuator_nets import FittedNet, fit_nets
from ksim_rl.identification.command import identify
from ksim_rl.identification.held_robot import hold
from ksim_rl.identification.joint_log import read_log
from ksim_rl.identification.training_overrides import net_override, time_step

# From low to high: s of a filter of first order, and the share of the effort limits that is left.
LAG_S = (0.03, 0.06)
STRENGTH = (0.4, 0.8)


@dataclass(frozen=True, kw_only=True)
class SlowArm(HiddenArm):
    """The worn arm, with servos that are slow and weak."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the arm."""
        rng = np.random.default_rng([self.seed, 58])
        spec = super().spec()
        for actuator in spec.actuators:
            actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTER
            actuator.dynprm = [rng.uniform(*LAG_S), *[0.0] * 9]
            strength = rng.uniform(*STRENGTH)
            actuator.forcerange = [strength * limit for limit in actuator.forcerange]
        return spec


def main() -> int:
    """Fit networks to a hidden arm, train with and without them, and write what both do on it."""
    options = asked("networked_policy", __doc__)
    hidden = SlowArm(seed=options.seed)
    with tempfile.TemporaryDirectory() as folder:
        nets, override = networks(hidden, Path(folder))
        returns = trained(hidden, [override], trainings=options.trainings, folder=Path(folder))
    figures = {f"slow_arm/{name}": mean(values) for name, values in returns.hidden.items()}
    for net in nets:
        figures[f"held_out/{net.name}"] = net.error
        figures[f"held_out_law/{net.name}"] = net.pd_error
    for name, value in figures.items():
        print(f"{name}: {value:.3f}")
    write("networked_policy", figures, returns, seed=options.seed)
    return 0


def networks(hidden: HiddenArm, folder: Path) -> tuple[list[FittedNet], str]:
    """Return the networks that `ksim-rl identify --nets` fits to a log of the hidden arm, and its override."""
    plan = folder / "plan.csv"
    log = folder / "log.csv"
    identify(["--propose", "arm", "--targets", "pos", "--output", str(plan)])
    log.write_text(follow(hidden, plan.read_text().splitlines(), has_efforts=True))
    robot = hold("arm")
    cfg = envs.task(TASK).cfg()
    nets = fit_nets(robot, read_log(log, robot), timestep=time_step(cfg), seed=hidden.seed)
    entries = []
    for number, net in enumerate(nets):
        path = folder / f"motors_{number}.safetensors"
        path.write_bytes(net.file)
        entries.append(net.entry(path))
    return nets, net_override(robot.name, entries, cfg)


if __name__ == "__main__":
    command_line.run(main)
