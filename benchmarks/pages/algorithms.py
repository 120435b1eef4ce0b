"""Makes the table of docs/learning.md that compares the properties of the algorithms."""

import dataclasses

from benchmarks.pages.table import table
from ksim_rl.algorithms import registry
from ksim_rl.modules import ActorCfg
from ksim_rl.objectives import BCCfg
from ksim_rl.trainers.algorithm import Algorithm

HEAD = (
    "`objective=`",
    "actions",
    "recurrent",
    "many GPUs",
    "mirror images",
    "gradient steps on a GPU",
)
YES_OR_NO = {True: "yes", False: "no"}


def algorithms() -> str:
    """Return the table: one row for each algorithm of the package."""
    found = [registry.algorithm(name) for name in registry.names()]
    ours = [algorithm for algorithm in found if algorithm.cfg.__module__.startswith("ksim_rl.")]
    return table(HEAD, [row(algorithm) for algorithm in ours])


def row(algorithm: Algorithm) -> list[str]:
    """Return the cells of an algorithm."""
    fields = {field.name for field in dataclasses.fields(algorithm.cfg)}
    return [
        f"`{algorithm.name}`",
        actions(algorithm),
        YES_OR_NO[algorithm.cfg.learns_on_sequences],
        YES_OR_NO[algorithm.on_ranks],
        YES_OR_NO["symmetry" in fields],
        gradient_steps(fields),
    ]


def actions(algorithm: Algorithm) -> str:
    """Return the kinds of actions that the policies of an algorithm have."""
    if issubclass(algorithm.cfg, BCCfg):
        return "continuous"
    if isinstance(algorithm.modules.actor, ActorCfg):
        return "continuous, discrete, or both"
    return "continuous, with bounds"


def gradient_steps(fields: set[str]) -> str:
    """Return what computes gradient steps by default or by a switch, from the fields of the settings."""
    if "kernels" in fields:
        return "[fused kernels](fused_ppo.md)"
    if "compile" in fields:
        return "torch with kernels for norms and AdamW, `objective.compile`"
    return "torch"
