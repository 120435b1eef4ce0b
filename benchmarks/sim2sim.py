"""Compares a policy's return on MuJoCo's C engine and in our physics, from the same starts.

    python -m benchmarks.sim2sim task=go1_velocity_flat policy=standing noise=false
    python -m benchmarks.sim2sim task=go1_velocity_flat policy=zoo:go1
    python -m benchmarks.sim2sim policy=runs/large task.sim.timestep=0.005 task.decimation=4 label=trained_at_10_ms

The policy comes from a run folder or the zoo, or is "standing": zero actions, which ask for the default pose. The same
env runs on both engines: starts, model parameters, commands, pushes and, with noise=true, the sensors' noise are the
same draws. A run that C itself trained is judged with another integrator and half the time step, and the words say so.
Other words are overrides of the run's config, for both engines. Figures go to benchmarks/results/sim2sim.json: a run's
under the task's name, zero actions under <task>/standing, without noise under .../without_noise, and with a `label`
under it.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from benchmarks import command_line, report
from ksim_rl import conf
from ksim_rl.checks import check_choice
from ksim_rl.export.sim2sim import ratio_error
from ksim_rl.trainers import RunCfg, checkpoint
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.build import build_env, build_evaluator
from ksim_rl.trainers.other_physics import in_c_engine, judged_by
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


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """What came of episodes: return, steps, and whether each ended by a fall, [N]."""

    return_N: np.ndarray
    length_N: np.ndarray
    fell_N: np.ndarray


def main() -> int:
    """Run both, print the table and write the figures; the code is 1 where returns differ by more than chance."""
    options, overrides = command_line.split(sys.argv[1:], OPTIONS)
    figures, words = measure(options, overrides)
    print(words)
    for name in ("return", "length", "fell"):
        print(f"{name:<10}{figures[name]:>12.4g}{figures[f'{name}_c_engine']:>12.4g}")
    print(
        f"return ratio {figures['return_ratio']:.4f} +- {figures['standard_error']:.4f} (standard error)"
    )
    where = group(options)
    path = report.write(
        "sim2sim",
        figures={f"{where}/{name}": value for name, value in figures.items()},
        device=torch.device(options["device"]),
        module="benchmarks.sim2sim",
    )
    print(f"written to {path}")
    return int(differs(figures))


def measure(options: dict[str, str], overrides: list[str]) -> tuple[dict[str, float], str]:
    """Run the policy that the options name on both engines; return the figures, and words that say which physics."""
    check_choice("noise", options["noise"], ("true", "false"))
    noise = options["noise"] == "true"
    count = command_line.whole_number("episodes", options["episodes"], least=2)
    ours = _policy(options, overrides)
    options["task"] = ours.cfg.task_name
    in_c, words = _in_c(ours.cfg, conf.fields_of(overrides))
    theirs = _policy(options, overrides, cfg=in_c)
    own = run(ours, episodes=count, noise=noise)
    other = run(theirs, episodes=count, noise=noise)
    return compared(own, other), f"{ours.cfg.task_name}, iteration {ours.iteration}, judged {words}"


def run(policy: Policy, *, episodes: int, noise: bool) -> Episodes:
    """Run whole episodes of a policy, one in each env, with or without the sensors' noise."""
    built = build_evaluator(policy.cfg, policy.actor, episodes=episodes, note=print)
    # Evaluations leave the noise out.
    built.env.train(noise)
    built()
    found = Episodes(
        return_N=built.return_E.cpu().numpy(),
        length_N=built.length_E.cpu().numpy(),
        fell_N=built.terminated_E.cpu().numpy(),
    )
    built.env.close(raise_if_closed=False)
    return found


def compared(own: Episodes, other: Episodes) -> dict[str, float]:
    """Return the figures of pairs of episodes that began alike."""
    ratio = float("nan")
    if own.return_N.mean():
        ratio = float(other.return_N.mean() / own.return_N.mean())
    return {
        "return_ratio": ratio,
        "standard_error": ratio_error(own.return_N, other.return_N),
        "episodes": len(own.return_N),
        "return": float(own.return_N.mean()),
        "return_c_engine": float(other.return_N.mean()),
        "length": float(own.length_N.mean()),
        "length_c_engine": float(other.length_N.mean()),
        "fell": float(own.fell_N.mean()),
        "fell_c_engine": float(other.fell_N.mean()),
    }


def differs(figures: dict[str, float]) -> bool:
    """Whether returns differ by more than chance, three standard errors and a thousandth."""
    return abs(figures["return_ratio"] - 1.0) > 3.0 * figures["standard_error"] + 1e-3


def group(options: dict[str, str]) -> str:
    """Return where the figures stand."""
    found = options["task"]
    if options["policy"] == "standing":
        found += "/standing"
    if options["noise"] == "false":
        found += "/without_noise"
    if options["label"]:
        found += f"/{options['label']}"
    return found


def _policy(options: dict[str, str], overrides: list[str], *, cfg: RunCfg | None = None) -> Policy:
    """Return the policy that the options name, with its own config, as overrides change it, or with another one."""
    if options["policy"] != "standing":
        return trained(locate(options["policy"]), overrides, device=options["device"], cfg=cfg)
    own = command_line.compose(
        [f"task={options['task']}", *overrides, f"device={options['device']}"]
    )
    return Policy(cfg=cfg or own, actor=standing(cfg or own), iteration=0)


def _in_c(cfg: RunCfg, given: list[str]) -> tuple[RunCfg, str]:
    """Return the config by which the C engine judges, and the words for that."""
    task = dataclasses.replace(cfg.task, sim=in_c_engine(cfg.task.sim))
    in_c = dataclasses.replace(cfg, task=task, device="cpu")
    return judged_by(in_c, trained=cfg.task.sim.engine, given=given)


def trained(
    run_folder: Path, overrides: list[str], *, device: str, cfg: RunCfg | None = None
) -> Policy:
    """Return the policy of a run, with its config as the overrides change it."""
    saved = checkpoint.load_latest(run_folder)
    if cfg is None:
        cfg = conf.changed({**saved.config, "device": device}, saved.path, overrides)
    return policy_of(saved, cfg=cfg)


def standing(cfg: RunCfg) -> TensorDictModuleBase:
    """Return an actor whose actions are all zero."""
    env = build_env(cfg, num_envs=1, seed=cfg.seed)
    actor = make_policy(cfg, env)
    env.close(raise_if_closed=False)
    last = [module for module in actor.modules() if isinstance(module, nn.Linear)][-1]
    for parameter in last.parameters():
        nn.init.zeros_(parameter)
    return actor


if __name__ == "__main__":
    command_line.run(main)
