"""This benchmark compares a policy's return on MuJoCo's C engine with that in our physics, from the same starts.

    python -m benchmarks.sim2sim task=go1_velocity_flat policy=standing noise=false
    python -m benchmarks.sim2sim task=go1_velocity_flat policy=zoo:go1
    python -m benchmarks.sim2sim policy=runs/large task.sim.timestep=0.005 task.decimation=4 label=trained_at_10_ms

The policy is that of a run folder or of the zoo, or "standing": zero actions, which ask for the default pose. Starts,
model parameters, commands and pushes are the recorded ones; with noise=true the sensors' noise is drawn anew, which a
policy that is about to fall amplifies. Other words are overrides of the run's config, for both engines. Figures go to
benchmarks/results/sim2sim.json: those of a run under the task's name, those of zero actions under <task>/standing,
without noise under .../without_noise, and with a `label` under it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import torch
from torch import nn

from benchmarks import command_line, report
from ksim_rl import conf
from ksim_rl.checks import check_choice
from ksim_rl.export import export_policy, sim2sim
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.run_folder import Policy, policy_of
from ksim_rl.zoo import locate

OPTIONS = {
    "task": "go1_velocity_flat",
    "policy": "standing",
    "noise": "true",
    "episodes": "100",
    "device": "cpu",
    "label": "",
}


def main() -> int:
    """Export, compare, print the table and write the figures."""
    options, overrides = command_line.split(sys.argv[1:], OPTIONS)
    check_choice("noise", options["noise"], ("true", "false"))
    episodes, noise = (
        command_line.whole_number("episodes", options["episodes"], least=2),
        options["noise"] == "true",
    )
    with tempfile.TemporaryDirectory() as folder:
        exported = Path(folder)
        if options["policy"] == "standing":
            policy = standing([f"task={options['task']}", *overrides])
        else:
            policy = trained(locate(options["policy"]), overrides, device=options["device"])
        export_policy(policy, exported, episodes=episodes, noise=noise)
        found = sim2sim(exported, episodes=episodes)
    print(found.table())
    group = found.task + "/standing" * (options["policy"] == "standing") + "/without_noise" * (not noise)
    group += f"/{options['label']}" * bool(options["label"])
    figures = {
        "return_ratio": found.return_ratio,
        "standard_error": found.standard_error,
        "episodes": episodes,
        "return": found.ours["return"],
        "return_c_engine": found.theirs["return"],
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


def trained(run: Path, overrides: list[str], *, device: str) -> Policy:
    """Return the policy of a run, with its config as the overrides change it."""
    saved = checkpoint.load_latest(run)
    return policy_of(saved, cfg=conf.changed({**saved.config, "device": device}, saved.path, overrides))


def standing(overrides: list[str]) -> Policy:
    """Return a policy whose actions are all zero."""
    cfg = command_line.compose([*overrides, "num_envs=4", "device=cpu"])
    env = build_env(cfg, num_envs=4, seed=cfg.seed)
    actor = make_policy(cfg, env)
    env.close(raise_if_closed=False)
    last = [module for module in actor.modules() if isinstance(module, nn.Linear)][-1]
    for parameter in last.parameters():
        nn.init.zeros_(parameter)
    return Policy(cfg=cfg, actor=actor, iteration=0)


if __name__ == "__main__":
    command_line.run(main)
