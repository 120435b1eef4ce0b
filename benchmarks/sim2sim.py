"""This benchmark compares a policy's return on MuJoCo's C engine with that in our physics, from the same starts.

    python -m benchmarks.sim2sim task=go1_velocity_flat policy=standing noise=false
    python -m benchmarks.sim2sim task=go1_velocity_flat policy=zoo:go1

The policy is that of a run folder or of the zoo, or "standing": zero actions, which ask for the default pose. Starts,
model parameters, commands and pushes are the recorded ones; with noise=true the sensors' noise is drawn anew, which a
policy that is about to fall amplifies. Figures go to benchmarks/results/sim2sim.json: those of a run under the task's
name, those of zero actions under <task>/standing, without noise under .../without_noise.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import torch
from torch import nn

from benchmarks import command_line, report
from ksim_rl.checks import check_choice
from ksim_rl.export import export, export_policy, sim2sim
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.run_folder import Policy
from ksim_rl.zoo import locate

OPTIONS = {
    "task": "go1_velocity_flat",
    "policy": "standing",
    "noise": "true",
    "episodes": "100",
    "device": "cpu",
}


def main() -> int:
    """Export, compare, print the table and write the figures."""
    options = command_line.options(sys.argv[1:], OPTIONS)
    check_choice("noise", options["noise"], ("true", "false"))
    episodes, noise = (
        command_line.whole_number("episodes", options["episodes"], least=2),
        options["noise"] == "true",
    )
    with tempfile.TemporaryDirectory() as folder:
        exported = Path(folder)
        if options["policy"] == "standing":
            export_policy(standing(options["task"]), exported, episodes=episodes, noise=noise)
        else:
            export(
                locate(options["policy"]), exported, device=options["device"], episodes=episodes, noise=noise
            )
        found = sim2sim(exported, episodes=episodes)
    print(found.table())
    group = found.task + "/standing" * (options["policy"] == "standing") + "/without_noise" * (not noise)
    figures = {
        "return_ratio": found.return_ratio,
        "standard_error": found.standard_error,
        "episodes": episodes,
        "return": found.ours["return"],
        "fell": found.ours["fell"],
        "causes": len(found.causes),
    }
    path = report.write(
        "sim2sim",
        figures={f"{group}/{name}": value for name, value in figures.items()},
        device=torch.device(options["device"]),
        module="benchmarks.sim2sim",
    )
    print(f"written to {path}")
    return 1 if found.causes else 0


def standing(task: str) -> Policy:
    """Return a policy of a task whose actions are all zero."""
    cfg = command_line.compose([f"task={task}", "num_envs=4", "device=cpu"])
    env = build_env(cfg, num_envs=4, seed=cfg.seed)
    actor = make_policy(cfg, env)
    env.close(raise_if_closed=False)
    last = [module for module in actor.modules() if isinstance(module, nn.Linear)][-1]
    for parameter in last.parameters():
        nn.init.zeros_(parameter)
    return Policy(cfg=cfg, actor=actor, iteration=0)


if __name__ == "__main__":
    command_line.run(main)
