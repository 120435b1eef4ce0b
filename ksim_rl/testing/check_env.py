"""This module runs the checks that every env has to pass, ours and yours, and reports all findings at once."""

from collections.abc import Callable, Collection

from torchrl.envs import EnvBase

from ksim_rl.checks import unknown_name
from ksim_rl.testing.check_cost import check_memory, check_syncs
from ksim_rl.testing.check_physics import check_c_engine
from ksim_rl.testing.check_rows import check_determinism, check_episode_end, check_partial_reset
from ksim_rl.testing.check_specs import check_actions, check_names, check_torchrl, check_values

CHECKS: dict[str, Callable[[EnvBase, int], None]] = {
    "names": check_names,
    "values": check_values,
    "torchrl": check_torchrl,
    "actions": check_actions,
    "determinism": check_determinism,
    "partial_reset": check_partial_reset,
    "episode_end": check_episode_end,
    "syncs": check_syncs,
    "memory": check_memory,
    "c_engine": check_c_engine,
}


def check_env(env: EnvBase, *, num_steps: int = 4, skip: Collection[str] = ()) -> None:
    """Check an env with batch size [E] against TorchRL's contract and ours; the env's seed and state change.

    The checks, by name: `names` (the label "E" on specs and data, ("E", "T") on rollouts), `values` (finite, inside
    their specs), `torchrl` (`check_env_specs`, which looks at neither), `actions` (wrong shapes and dtypes are
    refused), `determinism` (by seed, bit for bit, on the CPU), `partial_reset` (other rows stay bit-identical),
    `episode_end` (the true terminal observation), `syncs` (none), `memory` (no growth) and `c_engine` (one substep of
    a `ManagerBasedRlEnv` against MuJoCo's).

    Args:
        env: with at least two rows.
        num_steps: length of the rollouts that are looked at.
        skip: names of checks to leave out.

    Raises:
        AssertionError: with all findings, each with what to change.
        ValueError: if `skip` names no check.
    """
    for name in skip:
        if name not in CHECKS:
            raise unknown_name("check", name, CHECKS)
    findings = []
    for name, check in CHECKS.items():
        if name in skip:
            continue
        try:
            check(env, num_steps)
        except AssertionError as finding:
            findings.append(f"[{name}] {finding}")
    if findings:
        raise AssertionError("\n".join((f"{type(env).__name__} has {len(findings)} findings:", *findings)))
