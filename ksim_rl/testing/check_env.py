"""Runs the checks that every env has to pass, ours and yours, and reports all findings together."""

import gc
from collections.abc import Callable, Collection

from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.checks import unknown_name
from ksim_rl.testing.check_physics import check_c_engine
from ksim_rl.testing.check_python import check_python
from ksim_rl.testing.check_rows import check_determinism, check_episode_end, check_partial_reset
from ksim_rl.testing.check_specs import check_actions, check_names, check_torchrl, check_values
from ksim_rl.testing.check_terms import check_terms
from ksim_rl.testing.replays import Replays
from ksim_rl.testing.sync_count import count_syncs

_GROWTH_STEPS = 10


def check_syncs(env: EnvBase, num_steps: int) -> None:
    """A step with its masked reset never waits for the device."""
    replays = Replays(env, num_steps)
    root = replays.start()
    # The first step may compile and fill caches.
    _, root = replays.step(root, 0)
    # Steps with their masked resets only, as in a rollout.
    with count_syncs() as syncs:
        for index in range(1, num_steps):
            _, root = replays.step(root, index)
    if syncs.total:
        raise AssertionError(
            f"{num_steps - 1} steps make the host wait {syncs.total} times. Use masks and `torch.where` instead of "
            f"these, and `ksim_rl.envs.MaskedTransformedEnv` instead of TorchRL's `TransformedEnv`:\n{syncs.report()}"
        )


def check_memory(env: EnvBase, num_steps: int) -> None:
    """Steps leave no tensors behind."""
    replays = Replays(env, num_steps)
    root = replays.start()
    counts = []
    # Two equal rounds: tensors that the first one keeps may be a cache, more in the second one are a leak.
    for _ in range(2):
        for index in range(_GROWTH_STEPS):
            _, root = replays.step(root, index % num_steps)
        # Tensors in reference cycles are no leak.
        gc.collect()
        # `type`, because `isinstance` would ask proxies that warn when they are looked at.
        counts.append(sum(issubclass(type(thing), Tensor) for thing in gc.get_objects()))
    grown = counts[1] - counts[0]
    # At least one tensor per step; fewer may come from elsewhere.
    if grown >= _GROWTH_STEPS:
        raise AssertionError(
            f"{_GROWTH_STEPS} steps leave {grown} tensors behind. Something keeps what each step makes: look for lists "
            "and dicts that are appended to in `_step`, in a term or in a transform"
        )


CHECKS: dict[str, Callable[[EnvBase, int], None]] = {
    "names": check_names,
    "values": check_values,
    "terms": check_terms,
    "torchrl": check_torchrl,
    "actions": check_actions,
    "determinism": check_determinism,
    "partial_reset": check_partial_reset,
    "episode_end": check_episode_end,
    "syncs": check_syncs,
    "memory": check_memory,
    "python": check_python,
    "c_engine": check_c_engine,
}


def check_env(env: EnvBase, *, num_steps: int = 4, skip: Collection[str] = ()) -> None:
    """Check an env with batch size [E], E > 1, against TorchRL's contract and ours; the env's seed and state change.

    The checks, by name: `names` (the label "E" on specs and data, ("E", "T") on rollouts), `values` (of the shapes and
    dtypes of their specs, inside them, and finite; rewards and metrics, too), `terms` (of a `ManagerBasedRlEnv`: they
    write only what is their own), `torchrl` (`check_env_specs`, which looks at neither), `actions` (wrong shapes and
    dtypes are refused), `determinism` (by seed, bit for bit, on the CPU), `partial_reset` (other rows stay
    bit-identical), `episode_end` (the true terminal observation), `syncs` (none), `memory` (no growth), `python` (the
    same in each step, where steps are recorded) and `c_engine` (20 substeps of a `ManagerBasedRlEnv` against MuJoCo's).
    They look at rollouts of `num_steps`; `skip` leaves some out. Raises one AssertionError with all findings, each with
    what to change, or what the env raised.
    """
    for name in skip:
        if name not in CHECKS:
            raise unknown_name("check", name, CHECKS)
    findings = []
    for name, check in CHECKS.items():
        # All checks run, whatever the earlier ones have found.
        if name in skip:
            continue
        try:
            check(env, num_steps)
        except AssertionError as finding:
            findings.append(f"[{name}] {finding}")
        # Whatever an env raises belongs to the findings, with the term that it names.
        except Exception as error:
            first = (str(error).splitlines() or [""])[0]
            notes = " ".join(getattr(error, "__notes__", []))
            findings.append(f"[{name}] {type(error).__name__}: {first} {notes}".rstrip())
    if findings:
        raise AssertionError(
            "\n".join((f"{type(env).__name__} has {len(findings)} findings:", *findings))
        )
